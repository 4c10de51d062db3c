"""generator reference for VNN-LIB questions: made, read by the score, verified, found out."""

import csv
import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from generator.cli import main
from generator.reference.rows import COLUMNS, REFERENCE, WITNESSES, read_rows
from harness.catalogue import load_references
from harness.records import Verdict
from harness.scoring import INCORRECT, Claim, score

CHECKOUT = Path(__file__).resolve().parents[3]
NAME = "TD3_L21_64x64_C1"
PROVED, REFUTED = (f"{NAME}.open_loop.{rest}" for rest in ("f3m.steer", "f2m.missing1"))


def run(root, work, *arguments):
    options = ["reference", "--root", str(root), "--work", str(work), *arguments]
    return CliRunner().invoke(main, options)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A root with two instances and their results, and the work folder."""
    base = tmp_path_factory.mktemp("queries")
    root, work = base / "root", base / "work"
    folder, specs = root / "benchmarks" / "open_loop", root / "vnnlib" / "open_loop" / "1.0"
    for new in (folder, specs, root / "onnx"):
        new.mkdir(parents=True)
    shutil.copy(CHECKOUT / "onnx" / f"{NAME}.onnx", root / "onnx")
    lines = []
    for id in (PROVED, REFUTED):
        shutil.copy(CHECKOUT / "vnnlib" / "open_loop" / "1.0" / f"{id}.vnnlib.gz", specs)
        lines.append(f"../../onnx/{NAME}.onnx,../../vnnlib/open_loop/1.0/{id}.vnnlib,60\n")
    (folder / "instances.csv").write_text("".join(lines))
    done = run(root, work, "--json", "--category", "open_loop")
    assert done.exit_code == 0, done.output
    counts = {"category": "open_loop", "sat": 1, "unsat": 1, "unknown": 0}
    assert json.loads(done.stdout) == counts
    return root, work


def test_rows_say_by_what_evidence(made):
    rows = read_rows(made[0] / "benchmarks" / "open_loop")
    assert (rows[PROVED].verdict, rows[REFUTED].verdict) == ("unsat", "sat")
    assert 0 < float(rows[PROVED].margin_lower) < 1
    assert -1 < float(rows[REFUTED].margin_upper) < 0
    assert all(row.source == id and len(row.evidence) == 64 for id, row in rows.items())


def test_a_claim_against_the_results_is_incorrect(made):
    references = load_references(made[0] / "benchmarks")
    claims = [Claim("liar", "open_loop", id, Verdict.UNSAT, 1.0, 60.0) for id in (PROVED, REFUTED)]
    points = {j.claim.instance: j.points for j in score(claims, references).judgements}
    assert points == {PROVED: 10, REFUTED: INCORRECT}


def test_what_was_made_verifies_even_without_its_certificates(copied):
    root, work = copied
    shutil.rmtree(work)
    done = run(root, work, "--verify")
    assert done.exit_code == 0, done.output
    assert "2 rows (1 sat, 1 unsat); 0 failed" in done.output


def test_false_rows_are_named(copied):
    root, work = copied
    shutil.rmtree(work / "prove-own")  # of another place
    folder = root / "benchmarks" / "open_loop"
    rows = read_rows(folder)
    lines = {id: vars(row).copy() for id, row in rows.items()}
    lines[PROVED]["margin_lower"] = repr(float(rows[PROVED].margin_lower) + 1e-9)
    lines[REFUTED] |= {"verdict": "unsat", "margin_lower": "0.01", "margin_upper": ""}
    with (folder / REFERENCE).open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(lines.values())
    done = run(root, work, "--verify", "--json")
    assert done.exit_code == 1
    faults = {f["instance"]: f["fault"] for f in map(json.loads, done.stdout.splitlines())}
    assert "proved is" in faults[PROVED]
    assert "could not be made again" in faults[REFUTED]


def test_a_witness_that_does_not_violate_fails(copied):
    root, work = copied
    file = root / "benchmarks" / "open_loop" / WITNESSES
    line = json.loads(file.read_text())
    file.write_text(json.dumps(line | {"witness": line["witness"].replace("1.", "2.")}) + "\n")
    done = run(root, work, "--verify", "--instance", REFUTED)
    assert done.exit_code == 1
    assert "sha256" in done.output


def test_an_unknown_category_is_named(made):
    done = run(*made, "--category", "nothing")
    assert done.exit_code == 2
    assert "nothing" in done.output

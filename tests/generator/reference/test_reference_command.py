"""generator reference: made, killed, read by the score, verified, and found out where false."""

import csv
import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from click.testing import CliRunner
from quick_root import CHECKOUT, NAME, make_root

from generator.cli import main
from generator.reference.rows import COLUMNS, REFERENCE, WITNESSES, Row, read_rows
from generator.reference.verify import margin_fault
from harness.catalogue import load_references
from harness.records import Verdict
from harness.scoring import INCORRECT, Claim, score

PROVED, IMPLIED, REFUTED = (
    f"{NAME}.quick.{rest}.clearance" for rest in ("straight05", "straight03", "nose05")
)


def run(root, work, *arguments):
    options = ["reference", "--root", str(root), "--work", str(work), *arguments]
    return CliRunner().invoke(main, options)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A root with three instances and their results, and the work folder."""
    base = tmp_path_factory.mktemp("reference")
    root, work = base / "root", base / "work"
    make_root(
        root,
        dict.fromkeys((PROVED, IMPLIED, REFUTED), 60),
        PROVED,
        lambda whole: [whole.model_copy(update={"id": IMPLIED, "steps": 3})],
    )
    done = run(root, work, "--json")
    assert done.exit_code == 0, done.output
    counts = {"category": "quick", "sat": 1, "unsat": 2, "unknown": 0}
    assert json.loads(done.stdout) == counts
    return root, work


def test_one_proof_stands_for_the_shorter_question_too(made):
    rows = read_rows(made[0] / "benchmarks" / "quick")
    assert [rows[id].verdict for id in (PROVED, IMPLIED, REFUTED)] == ["unsat", "unsat", "sat"]
    assert rows[IMPLIED].source == rows[PROVED].source == PROVED
    assert 0 < float(rows[PROVED].margin_lower) <= float(rows[PROVED].margin_upper)
    assert float(rows[REFUTED].margin_upper) <= 0


def test_a_witness_settles_what_was_tried_beside_it_and_not_found(tmp_path):
    root, work = tmp_path / "root", tmp_path / "work"

    def derive(first):
        wider = first.initial_set.model_copy(update={"s": (0.5, 0.56)})
        return [first.model_copy(update={"id": IMPLIED, "steps": 4, "initial_set": wider})]

    limits = {REFUTED: 60, IMPLIED: 0.1}  # the second ends before Python starts
    folder = make_root(root, limits, REFUTED, derive)
    done = run(root, work, "--json")
    assert done.exit_code == 0, done.output
    row = read_rows(folder)[IMPLIED]
    assert (row.verdict, row.source) == ("sat", REFUTED)
    assert run(root, work, "--verify").exit_code == 0


def test_a_claim_against_the_results_is_incorrect(made):
    references = load_references(made[0] / "benchmarks")
    claims = [Claim("liar", "quick", id, Verdict.UNSAT, 1.0, 60.0) for id in (PROVED, REFUTED)]
    points = {j.claim.instance: j.points for j in score(claims, references).judgements}
    assert points == {PROVED: 10, REFUTED: INCORRECT}


def test_killed_in_the_middle_it_goes_on(copied, tmp_path):
    root, _ = copied
    work = tmp_path / "new"
    command = [sys.executable, "-m", "generator", "reference", f"--root={root}", f"--work={work}"]
    with subprocess.Popen([*command, "--instance", PROVED], stderr=subprocess.DEVNULL) as process:
        # Its run of the harness has begun.
        while process.poll() is None and not (work / "prove-own" / "run.sqlite").exists():
            time.sleep(0.01)
        process.kill()
    done = run(root, work, "--instance", PROVED, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["unsat"] == 1


def test_made_again_it_runs_nothing_and_writes_the_same(made):
    file = made[0] / "benchmarks" / "quick" / REFERENCE
    before = file.read_bytes()
    assert run(*made).exit_code == 0
    assert file.read_bytes() == before


def test_what_was_made_verifies_even_without_its_certificates(copied):
    root, work = copied
    shutil.rmtree(work)
    done = run(root, work, "--verify")
    assert done.exit_code == 0, done.output
    assert "3 rows (1 sat, 2 unsat); 0 failed" in done.output


def test_false_rows_are_named(copied):
    root, work = copied
    folder = root / "benchmarks" / "quick"
    rows = read_rows(folder)
    lines = {id: vars(row).copy() for id, row in rows.items()}
    lines[PROVED]["margin_lower"] = repr(float(rows[PROVED].margin_lower) + 1e-9)
    lines[IMPLIED]["evidence"] = "0" * 64
    lines[REFUTED] |= {"verdict": "unsat", "margin_lower": "0.01"}
    lines[REFUTED] |= {"source": PROVED, "evidence": rows[PROVED].evidence}
    with (folder / REFERENCE).open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(lines.values())
    done = run(root, work, "--verify", "--same-bytes", "--json")
    assert done.exit_code == 1
    faults = {f["instance"]: f["fault"] for f in map(json.loads, done.stdout.splitlines())}
    assert "proved is" in faults[PROVED]
    assert "sha256" in faults[IMPLIED]
    assert f"a proof of {PROVED} does not prove it" in faults[REFUTED]


def test_another_accepted_certificate_is_a_note_unless_the_same_bytes_are_asked_for():
    row = Row("i", "unsat", "0.01", "", "proof", "i", "0" * 64, "", "", "")
    assert margin_fault(row, proved=0.0099995, same=False) == ""
    assert "proved is" in margin_fault(row, proved=0.009, same=False)
    assert "proved is" in margin_fault(row, proved=0.0099995, same=True)
    assert "proved is" in margin_fault(replace(row, margin_lower="nan"), proved=1.0, same=False)
    assert "proved is" in margin_fault(replace(row, margin_lower="0"), proved=1.0, same=True)


def test_a_witness_that_does_not_crash_fails(copied):
    root, work = copied
    file = root / "benchmarks" / "quick" / WITNESSES
    line = json.loads(file.read_text())
    harmless = json.dumps(json.loads(line["witness"]) | {"theta": 0.0})
    file.write_text(json.dumps(line | {"witness": harmless}) + "\n")
    done = run(root, work, "--verify", "--instance", REFUTED)
    assert done.exit_code == 1
    assert "sha256" in done.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--category", "nothing"], "choose quick"),
        (["--controller", "nobody"], "--controller nobody"),
        (["--instance", "none"], "--instance none"),
        (["--sample", "3"], "--verify"),
    ],
)
def test_what_is_not_there_is_named(made, arguments, message):
    done = run(*made, *arguments)
    assert done.exit_code == 2
    assert message in done.output


def test_a_sample_of_the_published_results_holds(tmp_path):
    done = run(
        CHECKOUT, tmp_path, "--verify", "--category", "quick", "--sample", "2", "--seed", "7"
    )
    assert done.exit_code == 0, done.output
    assert "2 rows" in done.output

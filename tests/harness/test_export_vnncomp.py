"""Folders for VNN-COMP's scoring: names, columns, witnesses, checks; what is refused."""

import csv
import gzip
import hashlib
import json
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest
from harness_helpers import harness

from generator.vnncomp import benchmark_name as published_name
from harness import vnncomp
from harness.records import WitnessCheck, verdict_of
from harness.tiny import make_tiny
from harness.vnncomp import export_vnncomp
from racecar.errors import BadInput

SHA = 64 * "0"
WITNESS_1 = b"((X_0 1.0)\n (X_1 -2.5e-3)\n(Y_0 .5))\n"
WITNESS_2 = b"X float32 [1,1]\n1.0\nY float32 [1,1]\n2.0\n"


@dataclass
class Stored:
    """A run as the export reads it."""

    rows: list = field(default_factory=list)
    witnesses: dict = field(default_factory=dict)
    checks: dict = field(default_factory=dict)
    path: Path = Path("run")

    def add(self, name, result, version="1.0", category="open_loop", witness=None, outcome=None,
            spec=None):  # fmt: skip
        record = SimpleNamespace(
            instance=name,
            category=category,
            onnx="../onnx/sub/net.onnx",
            spec=spec or f"../vnnlib/{category}/{version}/{name}.vnnlib",
            tool="prover",
            prepare_time=0.25,
            run_time=1.5,
            result=result,
            verdict=verdict_of(result),
        )
        self.rows.append(record)
        if witness is not None:
            self.witnesses[name] = witness
        if outcome is not None:
            self.checks[name] = WitnessCheck(
                instance=name,
                outcome=outcome,
                message="as it is",
                witness_sha256=SHA,
                spec_sha256=SHA,
                onnx_sha256=SHA,
                checked_with={"closedlap": "0.1.0", "onnxruntime": "1.20"},
            )
        return self

    def records(self):
        return sorted(self.rows, key=lambda r: (r.category, r.instance))

    def witness(self, record):
        return self.witnesses.get(record.instance, b"")

    def check(self, instance):
        return self.checks.get(instance)


def test_rows_and_paths_are_those_of_the_published_benchmarks(tmp_path):
    run = Stored().add("b", "unsat").add("a", "run_instance_timeout").add("c", "error_exit_code_7")
    run.add("k1", "no_result_in_file", category="unrolled")
    first, second = export_vnncomp(run, tmp_path)
    assert first.folder == tmp_path / "prover" / "2026_closedlap_open_loop"
    assert second.folder == tmp_path / "prover" / "2026_closedlap_unrolled"
    with (first.folder / "results.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    root = "vnncomp2026_benchmarks/benchmarks/closedlap_open_loop/1.0"
    assert rows[1] == [
        "closedlap_open_loop",
        f"{root}/onnx/net.onnx",
        f"{root}/vnnlib/b.vnnlib",
        "0.250",
        "unsat",
        "1.500",
    ]
    assert [row[4] for row in rows] == ["run_instance_timeout", "unsat", "error_exit_code_7"]
    assert (first.rows, first.witnesses) == (3, 0)
    assert (first.folder / "vnnlib_version.txt").read_text() == "closedlap_open_loop  1.0\n"


def test_gzipped_files_are_named_bare_as_in_the_published_csv(tmp_path):
    run = Stored().add(
        "a", "sat", witness=WITNESS_1, outcome="correct", spec="1.0/vnnlib/a.vnnlib.gz"
    )
    run.rows[0].onnx, run.rows[0].spec = "1.0/onnx/net.onnx.gz", "1.0/vnnlib/a.vnnlib.gz"
    (done,) = export_vnncomp(run, tmp_path)
    assert "1.0/onnx/net.onnx,vnncomp" in (done.folder / "results.csv").read_text()
    assert "1.0/vnnlib/a.vnnlib,0.250" in (done.folder / "results.csv").read_text()
    assert (done.folder / "net_a.counterexample.gz").is_file()


@pytest.mark.parametrize(("version", "witness"), [("1.0", WITNESS_1), ("2.0", WITNESS_2)])
def test_a_witness_goes_with_its_check(tmp_path, version, witness):
    run = Stored().add("a", "sat", version, witness=witness, outcome="correct_with_tolerance")
    (done,) = export_vnncomp(run, tmp_path)
    packed = (done.folder / "net_a.counterexample.gz").read_bytes()
    assert gzip.decompress(packed) == witness
    check = json.loads((done.folder / "net_a.counterexample.check.json").read_text())
    assert check["result"] == "correct_up_to_tolerance"
    assert check["classification"] == "correct_with_tolerance"
    assert (check["establishes_sat"], check["score_credit"]) == (False, True)
    assert check["witness_sha256"] == hashlib.sha256(packed).hexdigest()
    assert check["benchmark"]["version"] == version
    # Not VNN-COMP's signature: its scoring is to check the witness itself.
    assert check["checker_version"] == "closedlap-0.1.0"
    assert done.witnesses == 1
    assert not done.notes


@pytest.mark.parametrize(("witness", "note"), [
    (b"", "there is no witness"),
    (b"\n  \n", "there is no witness"),
    (b"X_0 = 1", "left out"),
    (b"((X_0 one))", "left out"),
    (b"((X_0 1.0)", "left out"),
    (b"((X_0\t1.0))", "left out"),
    (b"((Z_0 1.0))", "left out"),
])  # fmt: skip
def test_what_would_end_their_scoring_is_left_out_with_a_note(tmp_path, witness, note):
    run = Stored().add("a", "sat", witness=witness, outcome="malformed")
    (done,) = export_vnncomp(run, tmp_path)
    assert not (done.folder / "net_a.counterexample.gz").exists()
    assert len(done.notes) == 1
    assert note in done.notes[0]
    check = json.loads((done.folder / "net_a.counterexample.check.json").read_text())
    assert (check["result"], check["witness_sha256"]) == ("no_ce", None)


def test_closed_loops_are_left_out_and_counted(tmp_path):
    run = Stored().add("j", "unsat", spec="quick/json/j.json", category="quick").add("a", "unsat")
    (done,) = export_vnncomp(run, tmp_path)
    assert done.rows == 1
    assert done.notes == ("left out, since they are not about VNN-LIB files: 1",)
    with pytest.raises(BadInput, match="no result on a VNN-LIB instance"):
        export_vnncomp(Stored().add("j", "unsat", spec="quick/json/j.json"), tmp_path / "other")


def test_versions_are_not_mixed_and_nothing_is_overwritten(tmp_path):
    with pytest.raises(BadInput, match="one version a benchmark"):
        export_vnncomp(Stored().add("a", "unsat").add("b", "unsat", "2.0"), tmp_path)
    with pytest.raises(BadInput, match="which version"):
        export_vnncomp(Stored().add("a", "unsat", spec="../x/a.vnnlib"), tmp_path)
    assert list(tmp_path.iterdir()) == []
    run = Stored().add("a", "unsat")
    export_vnncomp(run, tmp_path)
    run.add("k1", "unsat", category="unrolled")
    with pytest.raises(BadInput, match="2026_closedlap_open_loop: it exists"):
        export_vnncomp(run, tmp_path)
    assert not (tmp_path / "prover" / "2026_closedlap_unrolled").exists()


def test_benchmarks_are_called_as_they_are_published():
    for category in ("open_loop", "unrolled"):
        assert vnncomp.benchmark_name(category) == published_name(category)
        assert vnncomp.benchmark_name(published_name(category)) == published_name(category)


def test_a_folder_is_complete_or_absent(tmp_path, monkeypatch):
    def fail(self, target):
        raise OSError(28, "no space")

    monkeypatch.setattr(vnncomp.Path, "rename", fail)
    with pytest.raises(OSError, match="no space"):
        export_vnncomp(Stored().add("a", "unsat"), tmp_path)
    assert list((tmp_path / "prover").iterdir()) == []


def test_from_a_run_to_the_folder(tmp_path, monkeypatch):
    from harness.description import Format

    tiny = make_tiny(tmp_path, [Format.VNNLIB_1], 5)
    table = tmp_path / "benchmarks" / "tiny" / "instances.csv"
    table.parent.mkdir(parents=True)
    table.write_text(
        "".join(f"{t.entry.onnx},{t.entry.spec},5\n" for t in tiny if t.answer == "unsat")
    )
    monkeypatch.setenv("FAKE_ANSWER", '{"answer": "unsat"}')
    run = tmp_path / "run"
    ran = harness("run", "--tool", "fake", "--benchmarks", tmp_path / "benchmarks", "--out", run)
    assert ran.returncode == 0, ran.stderr
    done = harness("export", "--layout", "vnncomp", run, "-o", tmp_path / "out", "--json")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "out" / "fake" / "2026_closedlap_tiny"
    assert json.loads(done.stdout) == {"folder": str(folder), "rows": 3, "witnesses": 0}
    again = harness("export", "--layout", "vnncomp", run, "-o", tmp_path / "out")
    assert again.returncode == 2
    assert "it exists; give another folder" in again.stderr


def test_exporting_needs_no_torch():
    code = "import sys, harness.vnncomp, harness.cli; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)

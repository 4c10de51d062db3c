"""Verifiers of other people: real ones from PyPI, and descriptions tried on stand-ins."""

import json

import pytest
from harness_helpers import harness, log_of
from tools_venv import installed

from harness.adapter import judge
from harness.description import Format
from harness.tiny import make_tiny
from harness.tool import find_tool


def check(name):
    done = harness("check-tool", name, "--no-install", "--timeout", "120", "--json")
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("name", ["marabou", "vibecheck", "neuralsat"])
def test_a_verifier_from_pypi_answers_what_is_known(name, marker, monkeypatch):
    installed(name)
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(variable, "1")
    status, found = check(name)
    assert status == 0, found
    assert {f["level"] for f in found} == {"good"}
    assert len(found) == (10 if name == "vibecheck" else 5)


def benchmarks_of(tmp_path, formats, count=None):
    """A benchmarks folder with the tiny instances, or the first of them."""
    tiny = make_tiny(tmp_path, formats, 30)[:count]
    table = tmp_path / "benchmarks" / "tiny" / "instances.csv"
    table.parent.mkdir(parents=True)
    table.write_text("".join(f"{t.entry.onnx},{t.entry.spec},30\n" for t in tiny))
    return tmp_path / "benchmarks"


def run(tool, root, tmp_path):
    done = harness("run", "--tool", tool, "--benchmarks", root, "--out", tmp_path / "run", "--json")
    assert done.returncode == 0, done.stderr
    return {r["instance"]: r for r in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("tool", ["simulate", "flowstar"])
def test_tools_for_closed_loops_say_unknown_to_networks_at_once(tmp_path, tool, monkeypatch):
    monkeypatch.setenv("FLOWSTAR", "/bin/false")
    found = run(tool, benchmarks_of(tmp_path, [Format.VNNLIB_1], 1), tmp_path)
    assert {r["result"] for r in found.values()} == {"unknown"}
    log = log_of(tmp_path / "run", "difference_small")
    assert "not read VNN-LIB" in log or "flowstar reads json" in log


@pytest.mark.parametrize("format_", [Format.VNNLIB_1, Format.VNNLIB_2])
def test_the_reference_verifier_answers_questions_about_networks(tmp_path, format_):
    found = run("reference", benchmarks_of(tmp_path, [format_], 2), tmp_path)
    known = {tiny.entry.id: tiny.answer for tiny in make_tiny(tmp_path / "again", [format_], 30)}
    assert {id: r["result"] for id, r in found.items()} == {id: known[id] for id in found}
    assert all(r["witness_check"]["outcome"] == "correct"
               for r in found.values() if r["result"] == "sat")  # fmt: skip


@pytest.mark.parametrize(("printed", "result"), [
    ("$V: SAFE\nComputation completed: 70 flowpipe(s) computed.", "unsat"),
    ("$V: SAFE\nComputation not completed: 16 flowpipe(s) computed.", "unknown"),
    ("Computation completed\nMaximum jump depth is reached.\n$V: SAFE", "unknown"),
    ("Error: the flowpipe is too large\nComputation completed\n$V: SAFE", "unknown"),
    ("$V: UNSAFE\nComputation completed", "unknown"),
    ("$V: UNKNOWN\nComputation completed", "unknown"),
    ("", "unknown"),
])  # fmt: skip
def test_flowstar_is_believed_only_when_it_finished(printed, result):
    tool = find_tool("flowstar").description
    verdict = "Result of the safety verification on the computed flowpipes"
    assert judge(tool.result, printed.replace("$V", verdict)) == result


def test_flowstar_gets_a_model_on_standard_input(tmp_path, monkeypatch):
    program = tmp_path / "flowstar"
    program.write_text(
        "#!/bin/bash\ngrep -q '^hybrid reachability' || exit 1\n"
        "[ -d outputs ] && [ -d images ] || exit 1\necho Computation completed.\n"
        "echo Result of the safety verification on the computed flowpipes: SAFE\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("FLOWSTAR", str(program))
    root = benchmarks_of(tmp_path, [Format.JSON], 1)
    assert run("flowstar", root, tmp_path)["straight_short"]["result"] == "unsat"


@pytest.mark.parametrize(("tool", "variables", "test", "said"), [
    ("verisig", {"VERISIG": "program"},
     "for e in network.yml plant.pickle glue.pickle problem.json; do [ -f $1.$e ] || exit 1; done",
     "verisig: all safe"),
    ("juliareach", {"JULIA": "program", "JULIAREACH": "script.jl"},
     "[ -f $2 ] && [ -f $3 ] && [ $4 = 29 ] || exit 1", "verified"),
])  # fmt: skip
def test_own_installations_get_their_files(tmp_path, monkeypatch, tool, variables, test, said):
    (tmp_path / "script.jl").touch()
    program = tmp_path / "program"
    program.write_text(f"#!/bin/bash\n{test}\necho '{said}'\n")
    program.chmod(0o755)
    for name, file in variables.items():
        monkeypatch.setenv(name, str(tmp_path / file))
    root = benchmarks_of(tmp_path, [Format.JSON], 1)
    assert run(tool, root, tmp_path)["straight_short"]["result"] == "unsat"
    description = find_tool(tool).description
    assert judge(description.result, f"not {said}\n") == "unknown"


@pytest.mark.parametrize(("tool", "variable"), [("nnv", "NNV_VNNCOMP"), ("cora", "CORA_VNNCOMP")])
def test_vnncomp_scripts_of_others_are_called_through(tmp_path, monkeypatch, tool, variable):
    folder = tmp_path / "submission"
    folder.mkdir()
    (folder / "prepare_instance.sh").write_text('[ "$#" = 4 ] && echo "$*" > prepared\n')
    (folder / "run_instance.sh").write_text(
        '[ "$(cat prepared)" = "$1 $2 $3 $4" ] && [ "$6" = 30 ] && echo unsat > "$5"\n'
    )
    monkeypatch.setenv(variable, str(folder))
    root = benchmarks_of(tmp_path, [Format.VNNLIB_1], 1)
    assert {r["result"] for r in run(tool, root, tmp_path).values()} == {"unsat"}


def test_tools_lists_what_ships(tmp_path):
    table = harness("tools").stdout.splitlines()
    assert table[0].split() == ["tool", "version", "status", "reads"]
    rows = {row.split()[0]: row for row in table[1:]}
    assert "untested" in rows["flowstar"]
    assert "2.0.0" in rows["marabou"]
    shown = {r["tool"]: r for r in map(json.loads, harness("tools", "--json").stdout.splitlines())}
    assert rows.keys() == shown.keys()
    assert shown["vibecheck"]["accepts"]["formats"] == ["vnnlib-1.0", "vnnlib-2.0"]
    assert json.loads(harness("tools", "--schema").stdout)["title"] == "closedlap-tool-1.0"

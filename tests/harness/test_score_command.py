"""``harness score`` over several runs: references, contradictions, evidence that was touched."""

import contextlib
import json
import shutil
import sqlite3

import pytest
from harness_helpers import harness

from harness import scoring
from harness.records import Verdict
from harness.report import print_scores
from harness.scoring import Claim

SAT = '{"s": 0.28, "f": 9.9, "v": 0, "theta": 0}'
NEAR = '{"s": 0.30005, "f": 9.9, "v": 0, "theta": 0}'


def says_sat(witness):
    return f"printf 'sat\\n%s\\n' '{witness}' > \"$RESULTS\""


def edit(run, command, *values):
    """Tamper with what a run has stored."""
    with contextlib.closing(sqlite3.connect(run / "run.sqlite")) as database, database:
        assert database.execute(command, values).rowcount == 1


SAYS_UNSAT = 'echo unsat > "$RESULTS"'


@pytest.fixture
def contest(benchmarks, make_tool, tmp_path):
    """Return a function that runs a tool, made of a script, and returns the run folder."""
    benchmarks.add("one", (0.25, 0.5))

    def run(name, script):
        out = tmp_path / "runs" / name
        tool = make_tool(script, name=name)
        done = harness(
            "run", "--tool", tool, "--benchmarks", benchmarks.root, "--out", out, cwd=tmp_path
        )
        assert done.returncode in (0, 1), done.stderr
        return out

    return run


def score(benchmarks, *arguments):
    done = harness("score", *arguments, "--benchmarks", benchmarks.root, "--json")
    return done, [json.loads(line) for line in done.stdout.splitlines()]


def test_rows_have_the_fields_that_others_rely_on(benchmarks, contest):
    done, rows = score(benchmarks, contest("a", SAYS_UNSAT))
    assert done.returncode == 0
    expected = {
        "tool": "a", "category": "quick", "score": 10, "percent": 100.0, "sat": 0, "unsat": 1,
        "incorrect": 0, "unknown": 0, "timeout": 0, "error": 0,
    }  # fmt: skip
    assert expected.items() <= rows[0].items()
    assert {**expected, "category": "overall"}.items() <= rows[1].items()
    assert len(rows) == 2


def test_witness_of_one_tool_refutes_another(benchmarks, contest):
    a, b = contest("a", says_sat(SAT)), contest("b", SAYS_UNSAT)
    done, rows = score(benchmarks, a, b)
    assert done.returncode == 0
    assert [(r["tool"], r["score"]) for r in rows if r["category"] == "quick"] == [
        ("a", 10),
        ("b", -150),
    ]
    assert rows[0]["contradictions"] == [
        {"kind": "refuted", "instance": "one", "sat": ["a"], "unsat": ["b"]}
    ]
    assert "contradiction: quick/one: A tool's unsat is refuted" in done.stderr
    table = harness("score", a, b, "--benchmarks", benchmarks.root).stdout
    assert "only a solved, in quick: one" in table
    assert "contradiction: quick/one" in table


def test_near_miss_is_shown_and_costs_nothing(benchmarks, contest):
    done, rows = score(benchmarks, contest("a", says_sat(NEAR)), contest("b", SAYS_UNSAT))
    assert [r["score"] for r in rows] == [10, 10, 10, 10]
    assert rows[0]["contradictions"][0]["kind"] == "unsettled"
    assert "nobody is punished" in done.stderr


def test_reference_refuted_by_a_witness_is_shouted(benchmarks, contest):
    benchmarks.set_references(["one,unsat,0.01,0.02"])
    run = contest("a", says_sat(SAT))
    done, rows = score(benchmarks, run)
    assert done.returncode == 1
    assert rows[0]["score"] == 10
    assert rows[0]["contradictions"][0]["kind"] == "reference_refuted"
    assert done.stderr.startswith("REFERENCE CONTRADICTION: quick/one")
    done = harness("score", run, "--benchmarks", benchmarks.root)
    assert done.returncode == 1
    assert "REFERENCE CONTRADICTION: quick/one" in done.stdout


def test_run_shouts_too(benchmarks, make_tool, tmp_path):
    benchmarks.add("one", (0.25, 0.5))
    benchmarks.set_references(["one,unsat,0.01,0.02"])
    tool = make_tool(says_sat(SAT))
    arguments = ("run", "--tool", tool, "--benchmarks", benchmarks.root)
    done = harness(*arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert "REFERENCE CONTRADICTION" in done.stdout
    done = harness(*arguments, "--out", tmp_path / "other", "--json", cwd=tmp_path)
    assert "REFERENCE CONTRADICTION" in done.stderr
    assert len(done.stdout.splitlines()) == 1


def test_reference_with_a_witness_refutes_unsat(benchmarks, contest):
    benchmarks.set_references(["one,sat,,-0.02"])
    _, rows = score(benchmarks, contest("a", SAYS_UNSAT))
    assert rows[0]["score"] == -150


def test_reference_of_another_version_is_not_used(benchmarks, contest):
    run = contest("a", SAYS_UNSAT)
    benchmarks.add("one", (0.26, 0.5))
    benchmarks.set_references(["one,sat,,-0.02"])
    done, rows = score(benchmarks, run)
    assert rows[0]["score"] == 10
    assert "another version" in done.stderr


def test_unequal_time_limits_are_noted(benchmarks, contest, tmp_path):
    run = contest("a", SAYS_UNSAT)
    arguments = ("--tool", tmp_path / "tools" / "a", "--name", "b", "--timeout", "5")
    out = tmp_path / "b"
    assert harness("run", *arguments, "--benchmarks", benchmarks.root, "--out", out).returncode == 0
    done, rows = score(benchmarks, run, out)
    assert "quick: the tools were given different time limits" in done.stderr
    assert {r["tool"] for r in rows} == {"a", "b"}


def test_changed_witness_is_replayed_again(benchmarks, contest):
    run = contest("a", says_sat(NEAR))
    edit(run, "UPDATE witnesses SET content = ?", SAT.replace("0.28", "0.4").encode())
    _, rows = score(benchmarks, run)
    assert rows[0]["score"] == -150
    edit(run, "DELETE FROM checks")
    edit(run, "UPDATE witnesses SET content = ?", SAT.encode())
    _, rows = score(benchmarks, run)
    assert rows[0]["score"] == 10


def test_stored_check_needs_no_instances_and_can_be_made_again(benchmarks, contest, tmp_path):
    run = contest("a", says_sat(SAT))
    edit(run, """UPDATE checks SET json = replace(json, '"correct"', '"wrong"')""")
    _, rows = score(benchmarks, run)
    assert rows[0]["score"] == -150  # what is stored is believed, ...
    _, rows = score(benchmarks, run, "--recheck")
    assert rows[0]["score"] == 10  # ... unless asked


def test_bad_runs_are_one_line(benchmarks, contest, tmp_path):
    a = contest("a", SAYS_UNSAT)
    benchmarks.add("one", (0.26, 0.5))
    changed = contest("b", SAYS_UNSAT)
    broken = contest("c", SAYS_UNSAT)
    edit(
        broken, """UPDATE records SET json = replace(json, '"result":"unsat"', '"result":"sat"')"""
    )
    copy = tmp_path / "copy"
    shutil.copytree(a, copy)
    for runs, message in (
        ([tmp_path / "none"], "not a run folder"),
        ([tmp_path], "not a run folder"),
        ([a, changed], "another version of the instance"),
        ([a, copy], "already has a result for one"),
        ([broken], "verdict is unsat, but result is sat"),
        ([], "RUN"),
    ):
        done, rows = score(benchmarks, *runs)
        assert done.returncode == 2
        assert rows == []
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
    _, rows = score(benchmarks, a, a)
    assert rows[0]["score"] == 10


def test_numbers_are_whole_in_a_narrow_terminal(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    claim = Claim("some_tool", "some_category", "i", Verdict.UNSAT, 1.25, 10.0)
    print_scores(scoring.score([claim], {}))
    shown = capsys.readouterr().out
    for text in ("some_tool", "some_category", "100.0", "1.25", "incorrect"):
        assert text in shown
    assert "…" not in shown

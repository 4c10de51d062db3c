"""``harness score --explain`` says why a result got its points, with the numbers."""

import json

import pytest
from harness_helpers import harness

START = '{"s": %s, "f": 9.9, "v": 0, "theta": 0}'
UNSAT = 'echo unsat > "$RESULTS"'


def sat(s):
    return f"printf 'sat\\n%s\\n' '{START % s}' > \"$RESULTS\""


@pytest.fixture
def explained(benchmarks, make_tool, tmp_path):
    """Return a function: runs tools given as name=script, returns {tool: explanation}."""

    def explain(*options, **scripts):
        runs = []
        for name, script in scripts.items():
            tool, out = make_tool(script, name=name), tmp_path / "runs" / name
            runs.append(out)
            where = ("--benchmarks", benchmarks.root, "--out", out)
            done = harness("run", "--tool", tool, *where)
            assert done.returncode in (0, 1), done.stderr
        arguments = ("--explain", "one", *runs, "--benchmarks", benchmarks.root)
        done = harness("score", *arguments, "--json")
        rows = [json.loads(line) for line in done.stdout.splitlines()]
        shown = harness("score", *arguments).stdout
        for row in rows:
            assert f"{row['tool']}: {row['points']} points" in shown
            for reason in row["reasons"]:
                assert f"  {reason}\n" in shown
        return {row["tool"]: (row["points"], " ".join(row["reasons"])) for row in rows}, shown

    benchmarks.add("one", (0.25, 0.5))
    return explain


def test_refuted_unsat_names_the_witness_and_its_margin(benchmarks, explained):
    benchmarks.set_references(["one,sat,,-0.05"])
    found, shown = explained(a=sat(0.28), b=UNSAT)
    points, why = found["a"]
    assert points == 10
    assert "answered sat after" in why
    assert "of 10 s that it had" in why
    assert "found correct: least margin -0.02 m" in why
    points, why = found["b"]
    assert points == -150
    assert why.endswith("Refuted by the witness of a (least margin -0.02 m).")
    assert "The reference result is sat; best witness with margin -0.05." in shown
    assert "contradiction: quick/one: A tool's unsat is refuted by a witness" in shown


def test_reference_alone_refutes(benchmarks, explained):
    benchmarks.set_references(["one,sat,,-0.05"])
    points, why = explained(b=UNSAT)[0]["b"]
    assert (points, "Refuted by the reference result's witness" in why) == (-150, True)


def test_tolerance_and_failed_witnesses(explained):
    found, shown = explained(a=sat(0.30005), b=UNSAT, c=sat(0.4), d=sat(0.1))
    assert found["a"][0] == 10
    assert "found correct_with_tolerance: least margin 5e-05 m; the tolerance" in found["a"][1]
    assert found["b"][0] == 10
    assert "Against it stands the witness of a (least margin 5e-05 m" in found["b"][1]
    assert found["c"][0] == -150
    assert "found wrong: least margin 0.1 m" in found["c"][1]
    assert found["d"][0] == -150
    assert "out_of_box: the start lies 0.15 outside" in found["d"][1]
    assert "There is no reference result." in shown


def test_no_claim(explained):
    found, _ = explained(a="exit 3", b='echo unknown > "$RESULTS"', c="true", d='echo > "$RESULTS"')
    assert {points for points, _ in found.values()} == {0}
    assert (
        "It ended with an error, so what it wrote does not count (error_exit_code_3)"
        in (found["a"][1])
    )
    assert "It answered unknown after" in found["b"][1]
    assert "(no_result_in_file), which counts as unknown" in found["c"][1]
    assert "the first line of the result file is empty" in found["d"][1]


def test_unknown_instance_is_one_line(benchmarks, explained, tmp_path):
    explained(a=UNSAT)
    run = tmp_path / "runs" / "a"
    done = harness("score", "--explain", "on", run, "--benchmarks", benchmarks.root)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: no run has a result for instance on; one for one is there\n"

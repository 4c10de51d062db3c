"""``harness run`` with real tools: codes, records, limits, and going on after any end."""

import csv
import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from harness_helpers import SOON, carriers, harness, harness_process, wait_until

from harness.store import RunFolder

#: One answer, or misdeed, for every instance; the instance's ID says which.
MISDEEDS = """
case $ID in
  unsat) echo unsat > "$RESULTS" ;;
  sat_right) printf 'sat\\n{"s": 0.28, "f": 9.9, "v": 0, "theta": 0}\\n' > "$RESULTS" ;;
  sat_near) printf 'sat\\n{"s": 0.30005, "f": 9.9, "v": 0, "theta": 0}\\n' > "$RESULTS" ;;
  sat_wrong) printf 'sat\\n{"s": 0.4, "f": 9.9, "v": 0, "theta": 0}\\n' > "$RESULTS" ;;
  sat_outside) printf 'sat\\n{"s": 0.1, "f": 9.9, "v": 0, "theta": 0}\\n' > "$RESULTS" ;;
  sat_nan) printf 'sat\\n{"s": NaN, "f": 9.9, "v": 0, "theta": 0}\\n' > "$RESULTS" ;;
  sat_missing) echo sat > "$RESULTS" ;;
  unknown) echo unknown > "$RESULTS" ;;
  timeout) echo timeout > "$RESULTS" ;;
  error) echo error > "$RESULTS" ;;
  garbage) echo 'I am quite sure' > "$RESULTS" ;;
  nothing) ;;
  empty) : > "$RESULTS" ;;
  pipe) mkfifo "$RESULTS" ;;
  exit_3) echo unsat > "$RESULTS"; exit 3 ;;
  exit_139) exit 139 ;;
  segfault) kill -SEGV $$ ;;
  sleeps) sleep 1000 ;;
  answers_then_sleeps) echo unsat > "$RESULTS"; sleep 1000 ;;
  stubborn) trap '' TERM INT; while :; do sleep 0.05; done ;;
  leaves_child) setsid -f bash -c 'trap "" TERM; sleep 1000; sleep 1000'; echo unsat > "$RESULTS" ;;
  late_child) setsid -f bash -c "sleep 0.1; echo sat > $RESULTS"; echo unsat > "$RESULTS" ;;
  kills_parent) kill -KILL $PPID; sleep 1000 ;;
  removes_scratch) cd /; rm -rf "$(dirname "$RESULTS")" ;;
  floods) head -c 5000000 /dev/zero; echo unsat > "$RESULTS" ;;
  prepare_fails | prepare_sleeps) echo unsat > "$RESULTS" ;;
esac
"""
PREPARE = "case $ID in prepare_fails) exit 9 ;; esac"

EXPECTED = {
    "unsat": "unsat",
    "sat_right": "sat",
    "sat_near": "sat",
    "sat_wrong": "sat",
    "sat_outside": "sat",
    "sat_nan": "sat",
    "sat_missing": "sat",
    "unknown": "unknown",
    "timeout": "timeout",
    "error": "error",
    "garbage": "error",
    "nothing": "no_result_in_file",
    "empty": "no_result_in_file",
    "pipe": "no_result_in_file",
    "exit_3": "error_exit_code_3",
    "exit_139": "error_exit_code_139",
    "segfault": "error_exit_code_139",
    "sleeps": "run_instance_timeout",
    "answers_then_sleeps": "run_instance_timeout",
    "stubborn": "run_instance_timeout",
    "leaves_child": "unsat",
    "late_child": "unsat",
    "kills_parent": "error",
    "removes_scratch": "no_result_in_file",
    "floods": "unsat",
    "prepare_fails": "prepare_instance_error_9",
}
CHECKS = {
    "sat_right": "correct",
    "sat_near": "correct_with_tolerance",
    "sat_wrong": "wrong",
    "sat_outside": "out_of_box",
    "sat_nan": "malformed",
    "sat_missing": "missing",
}
LIMIT = 0.6


def lines(text):
    return [json.loads(line) for line in text.splitlines()]


def test_every_misdeed_has_its_code(benchmarks, make_tool, marker, tmp_path):
    for name, result in EXPECTED.items():
        # The honest ones get enough time for a busy machine.
        limit = LIMIT if result == "run_instance_timeout" else 20
        benchmarks.add(name, (0.25, 0.5), timeout=limit)
    tool, out = make_tool(MISDEEDS, PREPARE), tmp_path / "run"
    before = {p.name for p in tmp_path.iterdir()}
    done = harness_process(
        "run", "--tool", tool, "--benchmarks", benchmarks.root, "--out", out, "--json", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    results = {r["instance"]: r for r in lines(done.stdout)}
    assert {name: r["result"] for name, r in results.items()} == EXPECTED
    assert [r["instance"] for r in lines(done.stdout)] == list(EXPECTED)
    assert carriers(marker) == []
    assert {p.name for p in tmp_path.iterdir()} == {*before, "run"}

    folder = RunFolder.open(out)
    for name, result in results.items():
        record = folder.record(name)
        assert record.model_dump(mode="json") == {
            k: v for k, v in result.items() if k != "witness_check"
        }
        if name in CHECKS:
            assert result["witness_check"]["outcome"] == CHECKS[name]
            assert folder.check(name).outcome == CHECKS[name]
        else:
            assert result["witness_check"] is None
            assert record.witness is None
        if record.result == "run_instance_timeout":
            assert LIMIT < record.run_time < SOON
    assert 2**20 <= len(folder.log(folder.record("floods"))) < 1.1 * 2**20
    assert {p.name for p in out.iterdir()} == {"run.sqlite", "lock", "results.csv"}
    assert "I am quite sure" in results["garbage"]["detail"]

    with (out / "results.csv").open() as file:
        rows = list(csv.reader(file))
    assert all(len(row) == 6 for row in rows)
    assert {row[2]: (row[0], row[1], row[4]) for row in rows} == {
        f"quick/json/{name}.json": ("quick", "../onnx/straight.onnx", code)
        for name, code in EXPECTED.items()
    }
    scored = lines(harness("score", out, "--benchmarks", benchmarks.root, "--json").stdout)
    # Incorrect: the witnesses that are wrong, outside, NaN and missing.
    assert [(r["category"], r["sat"], r["unsat"], r["incorrect"]) for r in scored] == [
        ("quick", 2, 4, 4),
        ("overall", 2, 4, 4),
    ]
    exported = tmp_path / "x.csv"
    harness("export", "--layout", "csv", out, "-o", exported)
    assert exported.read_bytes() == (out / "results.csv").read_bytes()


def test_what_a_tool_is_given(benchmarks, make_tool, tmp_path):
    spec = benchmarks.add("one", timeout=12.0)
    tool = make_tool(
        'printf "%s|" "$@" "$PYTHON" "$PWD" "$TMPDIR"; [ -d "$TMPDIR" ] && echo; ls -A; '
        'cat left; echo unknown > "$RESULTS"',
        prepare='printf "%s|" "$@"; echo; echo prepared > left',
    )
    out = tmp_path / "run"
    harness("run", "--tool", tool, "--benchmarks", benchmarks.root, "--out", out, cwd=tmp_path)
    prepare, run, *rest = harness("log", out, "one").stdout.splitlines()
    common = ["v1", "quick", str(benchmarks.onnx), str(spec)]
    assert prepare.split("|")[:-1] == common
    *arguments, python, folder, temporary = run.split("|")[:-1]
    assert arguments[:4] == common
    assert arguments[5] == "12"
    assert python == sys.executable
    assert rest == ["left", "prepared"]  # both scripts share a folder that began empty
    assert not Path(folder).exists()
    assert not Path(temporary).exists()
    record = RunFolder(out).record("one")
    assert record.command[:2] == ["bash", str(tool / "run_instance.sh")]
    assert record.limits.kept_by in ("subreaper", "cgroup, subreaper")


def test_table_ends_with_the_score(benchmarks, make_tool, tmp_path):
    benchmarks.add("unsat", (0.25, 0.5)), benchmarks.add("sat_wrong", (0.25, 0.5))
    tool = make_tool(MISDEEDS)
    done = harness("run", "--tool", tool, "--benchmarks", benchmarks.root, cwd=tmp_path)
    assert done.returncode == 0
    head, unsat_or_sat, other, score_head, score_row = done.stdout.splitlines()[:5]
    assert head.split()[:2] == ["instance", "verdict"]
    assert "wrong: least margin 0.1 m" in unsat_or_sat + other
    assert score_head.split()[:4] == ["tool", "category", "score", "percent"]
    assert score_row.split()[:7] == ["fake", "quick", "-140", "0.0", "0", "1", "1"]
    (run,) = (tmp_path / "runs").iterdir()
    assert run.name.startswith("fake-20")


def test_timeout_option_replaces_every_timeout(benchmarks, make_tool, marker, tmp_path):
    benchmarks.add("sleeps", timeout=500.0)
    arguments = ("--benchmarks", benchmarks.root, "--timeout", "0.3", "--json")
    done = harness("run", "--tool", make_tool(MISDEEDS), *arguments, cwd=tmp_path)
    (result,) = lines(done.stdout)
    assert result["limits"]["wall_s"] == 0.3
    assert 0.3 < result["run_time"] < SOON


def test_install_runs_once_and_must_succeed(benchmarks, make_tool, tmp_path):
    benchmarks.add("unsat")
    log = tmp_path / "installed"
    tool = make_tool(MISDEEDS, install=f'echo "$@" >> {log}')
    arguments = ("run", "--tool", tool, "--benchmarks", benchmarks.root, "--out", tmp_path / "run")
    assert harness(*arguments).returncode == 0
    benchmarks.add("unknown")
    assert harness(*arguments, "--resume").returncode == 0
    assert log.read_text() == "v1\n"

    bad = make_tool(MISDEEDS, install="echo no compiler; exit 4", name="bad")
    out = tmp_path / "bad_run"
    done = harness("run", "--tool", bad, "--benchmarks", benchmarks.root, "--out", out)
    assert done.returncode == 2
    assert "install_tool.sh ended with status 4" in done.stderr
    assert f"harness log {out} shows" in done.stderr
    assert harness("log", out).stdout == "no compiler\n"
    assert RunFolder(out).records() == []
    assert harness("run", "--tool", bad, "--benchmarks", benchmarks.root, "--out", out, "--resume",
                   "--no-install").returncode == 0  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tool", "nope"], "tool 'nope' is unknown; choose one of abcrown, "),
        (["--tool", "{empty}"], "it has neither tool.toml nor prepare_instance.sh"),
        (["--tool", "{tool}", "--category", "nope"], "category 'nope' is unknown"),
        (["--tool", "{tool}", "--instance", "nope"], "instance nope: there is no such file"),
        (["--tool", "{tool}", "--benchmarks", "{empty}"], "it holds no category"),
        (["--tool", "{tool}", "--benchmarks", "nope"], "nope: there is no benchmarks folder"),
        (["--tool", "{tool}", "--timeout", "-1"], "--timeout"),
        (["--tool", "{tool}", "--timeout", "nan"], "--timeout"),
        (["--tool", "{tool}", "--timeout", "inf"], "--timeout"),
        (["--tool", "{tool}", "--name", "a/b"], "does not serve as a name"),
        (["--tool", "{tool}", "--resume"], "--out"),
        (["--tool", "{tool}", "--out", "{empty}"], "it exists; add --resume"),
        (["--tool", "{tool}", "--out", "{root}", "--resume"], "not a run folder"),
        ([], "--tool"),
    ],
)
def test_bad_usage_is_one_line_and_leaves_nothing(
    benchmarks, make_tool, tmp_path, arguments, message
):
    benchmarks.add("unsat")
    empty = tmp_path / "empty"
    empty.mkdir()
    names = {"empty": empty, "tool": make_tool(MISDEEDS), "root": benchmarks.root}
    arguments = [a.format(**names) for a in arguments]
    if "--benchmarks" not in arguments:
        arguments += ["--benchmarks", str(benchmarks.root)]
    before = sorted(tmp_path.rglob("*"))
    done = harness("run", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert sorted(tmp_path.rglob("*")) == before


class TestGoingOn:
    """Every test begins a run of slow instances that write down each start."""

    COUNT = 5

    @pytest.fixture
    def run(self, benchmarks, make_tool, tmp_path):
        for i in range(self.COUNT):
            benchmarks.add(f"i{i}")
        starts = tmp_path / "starts"
        tool = make_tool(f'echo "$ID" >> {starts}; sleep 0.25; echo unsat > "$RESULTS"')
        return ["run", "--tool", tool, "--benchmarks", benchmarks.root, "--out", tmp_path / "run"]

    def begin(self, run, records):
        """Start a harness and wait until it has stored some records."""
        command = [sys.executable, "-m", "harness", *map(str, run)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        with RunFolder(run[-1]) as folder:
            wait_until(lambda: len(folder.instances()) >= records, 30)
        return process

    def stored(self, run):
        with RunFolder.open(run[-1]) as folder:
            return {record.instance: record for record in folder.records()}

    def test_after_kill(self, run, marker, tmp_path):
        process = self.begin(run, records=2)
        time.sleep(random.uniform(0, 0.3))
        process.kill()
        process.communicate()
        before = self.stored(run)
        assert 2 <= len(before) < self.COUNT
        done = harness(*run, "--resume", "--json")
        assert done.returncode == 0, done.stderr
        after = self.stored(run)
        assert set(after) == {f"i{i}" for i in range(self.COUNT)}
        assert before.items() <= after.items()
        assert sorted(r["instance"] for r in lines(done.stdout)) == [
            f"i{i}" for i in range(self.COUNT)
        ]
        starts = (tmp_path / "starts").read_text().split()
        # The instance that was running when the harness was killed began twice, no other.
        assert len(starts) <= self.COUNT + 1
        assert not any(starts.count(name) > 1 for name in before)
        assert carriers(marker) == []

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_after_interrupt(self, run, marker, number):
        process = self.begin(run, records=1)
        process.send_signal(number)
        _, errors = process.communicate(timeout=10)
        assert process.returncode == 130
        assert carriers(marker) == []
        assert 1 <= len(self.stored(run)) < self.COUNT
        words = errors.decode().splitlines()
        assert words[0].startswith("to go on: harness run --tool ")
        assert words[0].endswith(" --resume")
        assert harness(*run, "--resume").returncode == 0
        assert len(self.stored(run)) == self.COUNT

    def test_two_harnesses_exclude_each_other(self, run, marker):
        process = self.begin([*run[:-2], "--timeout", "9", *run[-2:]], records=1)
        process.send_signal(signal.SIGSTOP)
        try:
            done = harness(*run, "--timeout", "9", "--resume")
        finally:
            process.send_signal(signal.SIGCONT)
        assert done.returncode == 2
        assert "another harness is working on it" in done.stderr
        process.communicate(timeout=30)
        assert process.returncode == 0
        assert len(self.stored(run)) == self.COUNT

    def test_finished_run_has_nothing_left_to_do(self, run, tmp_path):
        assert harness(*run).returncode == 0
        before = self.stored(run)
        assert harness(*run).returncode == 2
        assert harness(*run, "--resume").returncode == 0
        assert self.stored(run) == before
        assert len((tmp_path / "starts").read_text().split()) == self.COUNT

    def test_something_else_is_not_continued(self, run, benchmarks, make_tool):
        assert harness(*run).returncode == 0
        for change, message in (
            (["--timeout", "3"], "--timeout"),
            (["--tool", make_tool("", name="other")], "another tool"),
        ):
            done = harness(*run, "--resume", *change)
            assert done.returncode == 2
            assert message in done.stderr
        benchmarks.add("i0", (0.7, 0.71))
        done = harness(*run, "--resume")
        assert done.returncode == 2
        assert "another version" in done.stderr


def test_instance_that_changes_during_the_run_is_not_judged(benchmarks, make_tool, tmp_path):
    spec = benchmarks.add("sat_right", (0.25, 0.5))
    text = f"echo >> {spec}; ID=sat_right\n{MISDEEDS}"
    out = tmp_path / "run"
    done = harness("run", "--tool", make_tool(text), "--benchmarks", benchmarks.root, "--out", out)
    assert done.returncode == 2
    assert "not the one that fake was given" in done.stderr
    assert RunFolder(out).records() == []

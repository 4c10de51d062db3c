"""Described tools through the command line, as any tool: verdicts, witnesses, refusals, crashes."""

import gzip
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from harness_helpers import LONG, harness, log_of

from harness import adapter, environments
from harness.adapter import Question, find_witness, judge
from harness.description import Result, Witness
from harness.environments import ensure_environment, environment_folder
from harness.store import RunFolder
from harness.tiny import make_tiny
from harness.tool import RUN, find_tool
from racecar.errors import BadInput

HEAD = """
format = "closedlap-tool-1.0"
name = "described"
summary = "a test"
[accepts]
formats = ["json"]
"""
RULES = """
[result]
form = "rules"
[[result.rules]]
verdict = "unsat"
all = ['^SAFE$', 'completed']
none = ['Error']
[[result.rules]]
verdict = "sat"
all = ['^UNSAFE$']
[witness]
form = "text"
pattern = '(?s)^start (?P<witness>.*)$'
"""


@pytest.fixture
def make_described(tmp_path):
    """Return a function that makes a described tool whose command is a bash script."""

    def make(body, more=RULES, run="", head=HEAD):
        folder = tmp_path / "described"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / "body.sh").write_text(body)
        words = ["bash", "{folder}/body.sh", "{onnx}", "{spec}", "{timeout}", "{id}", "{category}"]
        text = f"{head}\n[run]\ncommand = {json.dumps(words)}\n{run}\n{more}"
        (folder / "tool.toml").write_text(text)
        return folder

    return make


def results(benchmarks, folder, tmp_path, *options):
    shutil.rmtree(tmp_path / "run", ignore_errors=True)
    done = harness(
        "run", "--tool", folder, "--benchmarks", benchmarks.root, "--out", tmp_path / "run",
        "--json", *options,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return {r["instance"]: r for r in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize(("printed", "verdict"), [
    ("echo SAFE; echo completed", "unsat"),
    ("echo SAFE", "unknown"),
    ("echo completed; echo UNSAFELY", "unknown"),
    ("echo SAFE >&2; echo completed", "unsat"),
    ("echo SAFE; echo completed; echo 'Error: none'", "unknown"),
    ("echo SAFE; echo completed; exit 3", "error_exit_code_3"),
    ("echo SAFE; echo completed; kill -SEGV $$", "error_exit_code_139"),
    ("head -c 1000000 /dev/zero; echo; echo SAFE; echo completed", "unsat"),
    ("(sleep 20 &) ; echo SAFE; echo completed", "unsat"),
])  # fmt: skip
def test_verdict_is_what_the_rules_say(benchmarks, make_described, marker, tmp_path,
                                       printed, verdict):  # fmt: skip
    benchmarks.add("a")
    found = results(benchmarks, make_described(printed), tmp_path)
    assert found["a"]["result"] == verdict


def test_what_is_too_long_to_be_read_whole_is_not_believed(
    benchmarks, make_described, tmp_path, monkeypatch, capfd
):
    # The adapter is a process of its own elsewhere; here the limit is made small.
    monkeypatch.setattr(adapter, "MOST_TEXT", 1000)
    folder = make_described("head -c 2000 /dev/zero; echo; echo SAFE; echo completed")
    spec = benchmarks.add("a")
    arguments = ("quick", str(benchmarks.onnx), str(spec), str(tmp_path / "result.txt"), "10")
    assert adapter.main(["run", str(folder), "v1", *arguments]) == 2
    assert "what it prints is longer than 1000 bytes" in capfd.readouterr().err
    assert not (tmp_path / "result.txt").exists()


def test_what_it_is_told_and_what_the_log_holds(benchmarks, make_described, tmp_path):
    spec = benchmarks.add("a", timeout=7.5)
    results(benchmarks, make_described('echo "$@"; echo err >&2'), tmp_path)
    log = log_of(tmp_path / "run", "a")
    # A reserve of one second, then whole seconds.
    assert log == f"{benchmarks.onnx} {spec} 6 a quick\nerr\n"


def test_a_witness_is_found_in_the_output(benchmarks, make_described, tmp_path):
    benchmarks.add("crash", steps=LONG)
    body = """echo UNSAFE; echo 'start {"s": 0.7, "f": 9.9, "v": 0.0, "theta": 0.0}'"""
    found = results(benchmarks, make_described(body), tmp_path)
    assert found["crash"]["result"] == "sat"
    assert found["crash"]["witness_check"]["outcome"] == "correct"


def test_sat_without_a_witness_is_no_answer(benchmarks, make_described, tmp_path):
    benchmarks.add("crash", steps=LONG)
    found = results(benchmarks, make_described("echo UNSAFE"), tmp_path)
    assert found["crash"]["verdict"] == "error"
    log = log_of(tmp_path / "run", "crash")
    assert "the witness is not where the description says" in log


def test_a_tool_may_write_the_result_file_itself(benchmarks, make_described, tmp_path):
    benchmarks.add("a")
    folder = make_described("", '[result]\nform = "vnncomp"\n')
    text = (folder / "tool.toml").read_text().replace('"{category}"', '"{results}"')
    (folder / "tool.toml").write_text(text)
    (folder / "body.sh").write_text('echo unsat > "$5"; exit 1')
    assert results(benchmarks, folder, tmp_path)["a"]["result"] == "error_exit_code_1"
    (folder / "tool.toml").write_text(text.replace("[result]", "status = [0, 1]\n[result]"))
    assert results(benchmarks, folder, tmp_path)["a"]["result"] == "unsat"


def test_what_it_does_not_read_is_unknown_at_once(benchmarks, make_described, tmp_path):
    benchmarks.add("a")
    head = HEAD.replace('"json"', '"vnnlib-2.0"')
    found = results(benchmarks, make_described("exit 9", head=head), tmp_path)
    assert found["a"]["result"] == "unknown"
    log = log_of(tmp_path / "run", "a")
    assert "described reads vnnlib-2.0, and this is json" in log
    head = HEAD + 'categories = ["lap"]\n'
    found = results(benchmarks, make_described("exit 9", head=head), tmp_path)
    assert found["a"]["result"] == "unknown"


def test_prepare_steps_leave_files_for_the_run(benchmarks, make_described, tmp_path):
    benchmarks.add("a")
    body = 'cat made.txt; cat; [ "$KEY" = a-value ] && echo completed'
    more = (
        'stdin = "{work}/in.txt"\n[run.environment]\nKEY = "{id}-value"\n'
        '[[prepare]]\ncommand = ["bash", "-c", "echo SAFE > made.txt; echo in > in.txt"]\n'
    )
    assert (
        results(benchmarks, make_described(body, more + RULES), tmp_path)["a"]["result"] == "unsat"
    )
    bad = more.replace("echo in > in.txt", "exit 5")
    found = results(benchmarks, make_described(body, bad + RULES), tmp_path)
    assert found["a"]["result"] == "prepare_instance_error_5"


def test_a_program_of_the_users_is_found_or_asked_for(
    benchmarks, make_described, tmp_path, monkeypatch
):
    benchmarks.add("a")
    program = '[programs.prover]\nvariable = "PROVER_HOME"\nhelp = "get the prover"\n'
    folder = make_described("$3", RULES + program)
    text = (folder / "tool.toml").read_text().replace('"{timeout}"', '"{prover}"')
    (folder / "tool.toml").write_text(text)
    done = harness("run", "--tool", folder, "--benchmarks", benchmarks.root, cwd=tmp_path)
    assert done.returncode == 2
    with RunFolder.open(next(tmp_path.glob("runs/*"))) as run:
        log = run.install_log().decode()
    assert log == "error: described: get the prover; then set PROVER_HOME to its path\n"
    prover = tmp_path / "prover"
    prover.write_text("#!/bin/sh\necho SAFE; echo completed\n")
    prover.chmod(0o755)
    monkeypatch.setenv("PROVER_HOME", str(prover))
    assert results(benchmarks, folder, tmp_path)["a"]["result"] == "unsat"


@pytest.mark.parametrize(("version", "witness"), [
    ("1.0", "((X_0 1.0)\n(X_1 0.25)\n(Y_0 0.75))\n"),
    ("2.0", "X float32 [1,2]\n1.0\n0.25\nY float32 [1,1]\n0.75\n"),
])  # fmt: skip
def test_values_become_either_syntax(tmp_path, version, witness):
    # y = x0 - x1, so the output is known.
    from harness.description import Format

    tiny = next(
        t for t in make_tiny(tmp_path, [Format(f"vnnlib-{version}")], 1)
        if t.entry.id == "difference_large"
    )  # fmt: skip
    question = Question("tiny", tiny.entry.onnx, tiny.entry.spec)
    where = Witness(form="values", inputs=r"^\s*x(?P<index>\d+) = (?P<value>\S+)")
    text = "sat\nInput assignment:\n\tx1 = 0.250000\n\tx0 = 1.000000\n\nOutput:\n\ty0 = 9\n"
    assert find_witness(where, text, question) == witness
    with pytest.raises(BadInput, match=r"the inputs \[1\] of the network only"):
        find_witness(where, text.replace("x0", "z0"), question)
    with pytest.raises(BadInput, match="takes 2 inputs, the witness has 1"):
        find_witness(where, text.replace("x1", "z1"), question)


@pytest.mark.parametrize(("x0", "result"), [("1.0", "sat"), ("0.25", "unknown"), ("7", "unknown")])
def test_a_checked_witness_that_earns_nothing_is_not_claimed(make_described, tmp_path, x0, result):
    # Of y = x0 - x1 with inputs in [0, 1], y >= 0.5 is asked for; x1 is 0.
    from harness.description import Format

    (tiny,) = (
        t for t in make_tiny(tmp_path / "set", [Format.VNNLIB_1], 30)
        if t.entry.id == "difference_large"
    )  # fmt: skip
    table = tmp_path / "set" / "benchmarks" / "tiny" / "instances.csv"
    table.parent.mkdir(parents=True)
    table.write_text(f"{tiny.entry.onnx},{tiny.entry.spec},30\n")
    i = RULES.index("[witness]")
    more = RULES[:i] + (
        "[witness]\nform = 'values'\ncheck = true\n"
        r"inputs = '^x(?P<index>\d) = (?P<value>\S+)'"
    )
    folder = make_described(
        f"echo UNSAFE; echo 'x0 = {x0}'; echo 'x1 = 0'",
        more,
        head=HEAD.replace("json", "vnnlib-1.0"),
    )
    done = harness(
        "run",
        "--tool",
        folder,
        "--benchmarks",
        table.parents[1],
        "--out",
        tmp_path / "run",
        "--json",
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["result"] == result
    if result == "sat":
        assert found["witness_check"]["outcome"] == "correct"
    else:
        assert "it says sat, but its witness is" in log_of(tmp_path / "run", "difference_large")


def test_gzipped_files_are_unpacked_before_the_tool_sees_them(make_described, tmp_path):
    from harness.description import Format

    tiny = make_tiny(tmp_path / "set", [Format.VNNLIB_2], 30)[0]
    for path in (tiny.entry.onnx, tiny.entry.spec):
        Path(f"{path}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    table = tmp_path / "set" / "benchmarks" / "tiny" / "instances.csv"
    table.parent.mkdir(parents=True)
    table.write_text(f"{tiny.entry.onnx},{tiny.entry.spec},30\n")
    folder = make_described(
        'grep -q "<2.0>" "$2" && [ -s "$1" ] && [ "$4" = difference_small ] && '
        "echo SAFE && echo completed",
        head=HEAD.replace("json", "vnnlib-2.0"),
    )
    options = ("--benchmarks", table.parents[1], "--out", tmp_path / "run", "--json")
    done = harness("run", "--tool", folder, *options)
    assert json.loads(done.stdout)["result"] == "unsat", done.stderr


def test_what_is_installed_is_found_whatever_home_the_tool_gets(
    benchmarks, make_described, tmp_path, monkeypatch
):
    monkeypatch.setenv("CLOSEDLAP_CACHE", str(tmp_path / "cache"))
    folder = make_described("", RULES + '[install]\npackages = [["prover==1"]]\n')
    text = (folder / "tool.toml").read_text().replace('"bash"', '"{bin}/prover"')
    (folder / "tool.toml").write_text(text)
    environment = environment_folder("described", [["prover==1"]])
    made = environment / "bin"
    monkeypatch.setattr(environments, "_call", lambda *_: made.mkdir(parents=True, exist_ok=True))
    ensure_environment("described", [["prover==1"]], 1)
    program = environment / "bin" / "prover"
    program.write_text("#!/bin/bash\necho SAFE; echo completed\n")
    program.chmod(0o755)
    command = find_tool(str(folder)).command(RUN, "quick", str(benchmarks.onnx),
        str(benchmarks.add("a")), str(tmp_path / "result.txt"), "10")  # fmt: skip
    other = {"HOME": str(tmp_path / "home"), "PATH": os.environ["PATH"]}
    subprocess.run(command, cwd=tmp_path, env=other, check=True)
    assert (tmp_path / "result.txt").read_text() == "unsat\n"


def test_the_first_rule_that_holds_decides():
    rules = (
        {"verdict": "unsat", "all": ("a",), "none": ("b",)},
        {"verdict": "timeout", "all": ("a",)},
    )
    result = Result(form="rules", rules=rules, otherwise="error")
    assert [judge(result, text) for text in ("a", "ab", "c")] == ["unsat", "timeout", "error"]


def test_wrong_usage_of_the_adapter_is_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "harness.adapter", "run", tmp_path, "v1"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("usage: ")

"""The tool ``fake`` does what it is told, per instance or for all."""

import json

import pytest
from harness_helpers import LONG, harness, log_of


def run(benchmarks, tmp_path, monkeypatch, answers=None, answer=None):
    if answers is not None:
        (tmp_path / "answers.json").write_text(json.dumps(answers))
        monkeypatch.setenv("FAKE_ANSWERS", str(tmp_path / "answers.json"))
    if answer is not None:
        monkeypatch.setenv("FAKE_ANSWER", json.dumps(answer))
    out = tmp_path / "run"
    options = ("--benchmarks", benchmarks.root, "--out", out, "--json")
    done = harness("run", "--tool", "fake", *options)
    assert done.returncode == 0, done.stderr
    return {r["instance"]: r for r in map(json.loads, done.stdout.splitlines())}


def test_untold_it_says_unknown(benchmarks, tmp_path, monkeypatch):
    benchmarks.add("a")
    assert run(benchmarks, tmp_path, monkeypatch)["a"]["result"] == "unknown"


def test_each_instance_gets_its_own_answer(benchmarks, tmp_path, monkeypatch):
    for name in ("crash", "safe", "segfault", "killed", "silent", "slow", "prepare", "other"):
        benchmarks.add(name, steps=LONG if name == "crash" else 5, timeout=1)
    start = {"s": 0.7, "f": 9.9, "v": 0.0, "theta": 0.0}
    found = run(
        benchmarks,
        tmp_path,
        monkeypatch,
        {
            "crash": {"answer": "sat", "witness": json.dumps(start)},
            "safe": {"answer": "unsat", "print": 1000, "delay": 0.2},
            "segfault": {"status": 139},
            "killed": {"answer": "unsat", "signal": 9},
            "silent": {"silent": True},
            "slow": {"answer": "unsat", "delay": 60},
            "prepare": {"prepare_status": 4},
            "*": {"answer": "timeout"},
        },
    )
    assert {name: r["result"] for name, r in found.items()} == {
        "crash": "sat",
        "safe": "unsat",
        "segfault": "error_exit_code_139",
        "killed": "error_exit_code_137",
        "silent": "no_result_in_file",
        "slow": "run_instance_timeout",
        "prepare": "prepare_instance_error_4",
        "other": "timeout",
    }
    assert found["crash"]["witness_check"]["outcome"] == "correct"
    assert found["safe"]["run_time"] > 0.2
    assert log_of(tmp_path / "run", "safe") == 1000 * "."


@pytest.mark.parametrize("answer", ["unsat", "unknown"])
def test_one_answer_for_all(benchmarks, tmp_path, monkeypatch, answer):
    benchmarks.add("a")
    benchmarks.add("b")
    found = run(benchmarks, tmp_path, monkeypatch, answer={"answer": answer})
    assert [r["result"] for r in found.values()] == [answer, answer]

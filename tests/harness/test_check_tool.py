"""check-tool on tools with one mistake each: it is named, and what to do about it."""

import json

import pytest
from harness_helpers import harness

from harness.description import Format
from harness.tiny import make_tiny

RIGHT = """case $ID in
  straight_short) echo unsat > $RESULTS;;
  straight_long) printf 'sat\\n{"s": 0.75, "f": 9.9, "v": 0.0, "theta": 0.0}' > $RESULTS;;
  start_unsafe) printf 'sat\\n{"s": 0.25, "f": 9.9, "v": 0.0, "theta": 0.0}' > $RESULTS;;
esac
"""


def check(folder, *options):
    done = harness("check-tool", folder, "--format", "json", "--json", *options)
    assert not done.stderr
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def test_a_good_tool_passes(make_tool, marker):
    status, found = check(make_tool(RIGHT))
    assert status == 0
    assert [f["level"] for f in found] == ["good", "good", "good"]
    done = harness("check-tool", make_tool(RIGHT, name="two"), "--format", "json")
    assert done.stdout.endswith("two: all right\n")


@pytest.mark.parametrize(("run", "what", "advice"), [
    ("true", "there is no result file", "run_instance.sh's 5th argument"),
    ("touch $RESULTS", "the first line of the result file is empty", "in the first line"),
    ("echo safe > $RESULTS", "'safe', not an answer", "first line must be sat, unsat"),
    ("echo 'Answer: unsat' > $RESULTS", "'Answer: unsat', not an answer", "nothing else"),
    ("sleep 60", "ran past its limit of 0.5 s", "6th argument"),
    ("no-such-command", "ended with status 127", "a command was not found"),
    ("kill -SEGV $$", "ended with status 139", "it crashed"),
    ("kill -KILL $$", "ended with status 137", "was memory short?"),
    ("echo unsat > $RESULTS; exit 3", "ended with status 3", "must end with 0"),
    ("echo error > $RESULTS", "it answers error", "its output may say why"),
])  # fmt: skip
def test_a_failure_is_named(make_tool, marker, run, what, advice):
    # Only where it is to be reached, the limit is short: the machine may be busy.
    limit = ("--timeout", "0.5") if run.startswith("sleep") else ()
    status, found = check(make_tool(f"echo trouble\n{run}"), *limit)
    assert status == 1
    assert {f["level"] for f in found} == {"wrong"}
    assert what in found[0]["what"]
    assert advice in found[0]["advice"]
    assert "trouble" in found[0]["output"]


@pytest.mark.parametrize(("old", "new", "what", "advice"), [
    ("unsat > ", "sat > ", "it says sat, and the answer is unsat", "150 points"),
    ("sat\\n{", "unsat\\n{", "it says unsat, and the answer is sat", "right way round"),
    ('{"s": 0.75, "f": 9.9, "v": 0.0, "theta": 0.0}', "", "its witness is missing", "write it"),
    ('{"s": 0.75,', '{"x": 0.75,', "its witness is malformed", '{"s": 0.7'),
    ('{"s": 0.75', '{"s": 0.65', "its witness is out_of_box", "17 digits"),
    ('{"s": 0.25', '{"s": 0.4', "its witness is wrong", "replay it"),
])  # fmt: skip
def test_a_wrong_answer_is_named_with_the_right_one(make_tool, marker, old, new, what, advice):
    assert old in RIGHT
    status, found = check(make_tool(RIGHT.replace(old, new, 1)))
    assert status == 1
    (wrong,) = (f for f in found if f["level"] == "wrong")
    assert what in wrong["what"]
    assert advice in wrong["advice"]


def test_unknown_is_a_doubt_and_its_advice_is_given_once(make_tool, marker):
    done = harness("check-tool", make_tool("echo unknown > $RESULTS"), "--format", "json")
    assert done.returncode == 0
    assert done.stdout.count("that is no mistake") == 1
    assert done.stdout.endswith("fake: nothing is wrong; 0 solved, 3 in doubt\n")


def test_tolerance_is_a_doubt(make_tool, marker):
    status, found = check(make_tool(RIGHT.replace('"s": 0.75', '"s": 0.69999', 1)))
    assert status == 0
    (doubt,) = (f for f in found if f["level"] == "doubt")
    assert "only up to the tolerance" in doubt["what"]


def test_writing_beside_the_instance_is_wrong(make_tool, marker):
    status, found = check(make_tool(f'{RIGHT}\ntouch "$(dirname "$4")/cache"'))
    assert status == 1
    wrong = [f for f in found if f["level"] == "wrong"]
    assert "/json/tiny/cache" in wrong[0]["what"]
    assert "TMPDIR" in wrong[0]["advice"]


def test_changing_the_instance_is_wrong(make_tool, marker):
    status, found = check(make_tool(f'{RIGHT}\necho >> "$4"'))
    assert status == 1
    assert any("cannot be judged" in f["what"] for f in found)


def test_writing_into_its_own_folder_is_a_doubt(make_tool, marker):
    status, found = check(make_tool(f'{RIGHT}\necho $ID >> "$(dirname "$0")/log"'))
    assert status == 0
    assert "tools/fake/log" in next(f for f in found if f["level"] == "doubt")["what"]


@pytest.mark.parametrize(("script", "content", "what"), [
    ("run_instance.sh", b"#!/bin/bash\r\necho unsat\r\n", "CR LF"),
    ("run_instance.sh", b"if true\necho unsat\n", "bash cannot read it"),
    ("install_tool.sh", b"exit 7\n", "install_tool.sh ended with status 7"),
    ("prepare_instance.sh", b"exit 7\n", "prepare_instance.sh ended with status 7"),
])  # fmt: skip
def test_broken_scripts_are_named(make_tool, marker, script, content, what):
    folder = make_tool(RIGHT)
    (folder / script).write_bytes(content)
    status, found = check(folder)
    assert status == 1
    assert what in found[0]["what"]


def test_described_tools_are_told_about_their_description(tmp_path, marker):
    done = harness("new-tool", "mine", "--toml", "-o", tmp_path / "mine")
    assert done.returncode == 0
    toml = tmp_path / "mine" / "tool.toml"
    toml.write_text(toml.read_text().replace('["echo"', '["false"'))
    status, found = check(tmp_path / "mine")
    assert status == 1
    assert "run.status" in found[0]["advice"]


@pytest.mark.parametrize("option", [(), ("--toml",)])
def test_a_new_tool_runs_as_it_is(tmp_path, marker, option):
    done = harness("new-tool", "mine", *option, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "harness check-tool mine" in done.stdout
    status, found = check(tmp_path / "mine")
    assert (status, {f["level"] for f in found}) == (0, {"doubt"})
    again = harness("new-tool", "mine", *option, cwd=tmp_path)
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)


def test_a_new_tool_needs_a_name_that_serves(tmp_path):
    done = harness("new-tool", "../mine", cwd=tmp_path)
    assert done.returncode == 2
    assert "letters, digits" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_tiny_answers_are_right_where_they_can_be_sampled(tmp_path):
    """Each network's largest output over a fine grid of its boxes, against what is asked."""
    import numpy as np
    import onnxruntime
    from vnnlib_reader import Read

    for tiny in make_tiny(tmp_path, [Format.VNNLIB_1, Format.VNNLIB_2], 1):
        read = Read(tiny.entry.spec)
        session = onnxruntime.InferenceSession(tiny.entry.onnx)
        axes = [np.linspace(0, 3, 61)] * read.inputs
        grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, read.inputs).astype(np.float32)
        outputs = session.run(None, {session.get_inputs()[0].name: grid})[0]
        hit = any(
            read.holds([float(a) for a in x], [float(a) for a in y])
            for x, y in zip(grid, outputs, strict=True)
        )
        assert hit == (tiny.answer == "sat"), tiny.entry.spec

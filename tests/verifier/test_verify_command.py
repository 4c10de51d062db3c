"""``verifier verify``: what it prints and writes, and its exit statuses."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from enclosed import TRACKS, zero_controller
from instances import everywhere, question, save
from threadpoolctl import threadpool_info

from harness.records import WitnessOutcome
from harness.replay import check_file
from racecar.controller import Controller, Layer, save_controller
from verifier.cli import main
from verifier.result import Result

FIELDS = {
    "instance", "verdict", "margin_lower", "margin_upper", "decided", "leaves", "paths",
    "time_s", "witness", "note", "network_time_s",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A safe and an unsafe instance with one controller that goes straight on."""
    monkeypatch.chdir(tmp_path)
    lower, upper = [0.65, 9.9, 0.0, 0.0], [0.85, 9.9, 0.0, 0.0]
    safe = question(zero_controller(5), lower, upper, steps=5)
    save(safe, tmp_path, "safe")
    wide = np.array([0.25, 9.9, 0.0, 0.0])
    save(replace(safe, lower=wide), tmp_path, "unsafe")
    return tmp_path


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    """Run the command in this process: exit status, standard output, standard error."""
    with pytest.raises(SystemExit) as stop:
        main(list(arguments))
    out, err = capsys.readouterr()
    status = stop.value.code
    assert isinstance(status, int)
    return status, out, err


def test_a_safe_instance(folder, capsys):
    status, out, err = run(capsys, "verify", "safe.json", "--result", "out/result")
    assert status == 0
    assert out.splitlines()[0] == "unsat  safe"
    assert "proved margin at least 0.3" in out
    assert "decided 100.0000%" in out
    assert not err
    assert (folder / "out/result").read_text() == "unsat\n"


def test_an_unsafe_instance(folder, capsys):
    status, out, _ = run(capsys, "verify", "unsafe.json", "--result", "result")
    assert status == 0
    assert out.splitlines()[0] == "sat  unsafe"
    assert "witness s = " in out
    verdict, witness = (folder / "result").read_text().splitlines()
    assert verdict == "sat"
    assert set(json.loads(witness)) == {"s", "f", "v", "theta"}
    assert 0.25 <= json.loads(witness)["s"] <= 0.3
    assert check_file(folder / "unsafe.json", folder / "result").outcome is WitnessOutcome.CORRECT


def test_json_is_one_object_on_one_line(folder, capsys):
    for name, verdict in (("safe", "unsat"), ("unsafe", "sat")):
        status, out, err = run(capsys, "verify", f"{name}.json", "--json")
        assert status == 0
        assert not err
        (line,) = out.splitlines()
        answer = json.loads(line)
        assert set(answer) == FIELDS
        assert answer["instance"] == name
        assert answer["verdict"] == verdict
        assert answer["decided"] == 1.0
        assert (answer["witness"] is not None) == (verdict == "sat")
        assert (answer["margin_lower"] is not None) == (verdict == "unsat")
        assert 0 < answer["time_s"] < 60


def test_a_time_limit(folder, capsys):
    status, out, _ = run(
        capsys, "verify", "safe.json", "--timeout", "0.001", "--result", "result", "--json"
    )
    assert status == 0
    answer = json.loads(out)
    assert answer["verdict"] == "unknown"
    assert answer["decided"] < 1
    assert answer["margin_lower"] is None
    assert "time limit" in answer["note"]
    assert (folder / "result").read_text() == "unknown\n"


def broken(folder, name: str) -> list[str]:  # noqa: PLR0912 (a table of cases)
    """Make one kind of bad input; return the arguments that ask for it."""
    path, text = folder / "safe.json", (folder / "safe.json").read_text()
    data = json.loads(text)
    match name:
        case "missing instance":
            return ["verify", "nowhere.json"]
        case "truncated instance":
            path.write_text(text[: len(text) // 2])
        case "not JSON":
            path.write_bytes(b"\xff\x00")
        case "low above high":
            data["initial_set"]["s"] = [0.85, 0.65]
            path.write_text(json.dumps(data))
        case "start in a wall":
            data["initial_set"]["s"] = [-0.1, 0.65]
            path.write_text(json.dumps(data))
        case "NaN in the start":
            path.write_text(text.replace('"s": [0.65, 0.85]', '"s": [0.65, NaN]'))
        case "other unsafe set":
            data["property"]["unsafe"][0][0][0][2] = 0.29
            path.write_text(json.dumps(data))
        case "missing controller":
            (folder / "controller.onnx").unlink()
        case "other controller":
            other = zero_controller(5).layers[0]
            changed = Layer(other.weights + np.float32(1), other.biases, "linear")
            save_controller(Controller((changed,)), folder / "controller.onnx")
        case "truncated controller":
            content = (folder / "controller.onnx").read_bytes()
            (folder / "controller.onnx").write_bytes(content[:50])
        case "time limit of zero":
            return ["verify", "safe.json", "--timeout", "0"]
        case "result in place of a folder":
            (folder / "taken").mkdir()
            return ["verify", "safe.json", "--result", "taken"]
        case "unknown option":
            return ["verify", "safe.json", "--fast"]
        case "no instance":
            return ["verify"]
        case "unknown command":
            return ["prove", "safe.json"]
    return ["verify", "safe.json"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing instance", "nowhere.json"),
        ("truncated instance", "safe.json"),
        ("not JSON", "safe.json"),
        ("low above high", "initial_set"),
        ("start in a wall", "wall"),
        ("NaN in the start", "safe.json"),
        ("other unsafe set", "property"),
        ("missing controller", "controller.onnx"),
        ("other controller", "sha256"),
        ("truncated controller", "controller.onnx"),
        ("time limit of zero", "timeout"),
        ("result in place of a folder", "taken"),
        ("unknown option", "--fast"),
        ("no instance", "INSTANCE"),
        ("unknown command", "prove"),
    ],
)
def test_bad_input_gives_one_line_and_status_2(folder, capsys, name, words):
    status, out, err = run(capsys, *broken(folder, name))
    assert status == 2
    (line,) = err.splitlines()
    assert line.startswith("error: ")
    assert words in line
    if name != "result in place of a folder":
        assert not out
    assert not [p for p in folder.iterdir() if p.suffix == ".part"]


def test_as_a_program(folder):
    """``python -m verifier`` is the same command; its status is the process's."""
    command = [sys.executable, "-m", "verifier", "verify"]
    done = subprocess.run([*command, "safe.json"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stdout.startswith("unsat  safe\n")
    assert done.stderr == ""
    bad = subprocess.run([*command, "nowhere.json"], capture_output=True, text=True, check=False)
    assert bad.returncode == 2
    assert bad.stderr.startswith("error: nowhere.json")
    assert "Traceback" not in bad.stderr


def test_witnesses_are_written_to_the_last_bit(tmp_path):
    start = {"s": 0.1 + 0.2, "f": np.nextafter(9.9, 10), "v": 5e-324, "theta": -1 / 3}
    Result("sat", None, -0.1, 1.0, 1, 1, 0.1, {k: float(v) for k, v in start.items()}).write(
        tmp_path / "result"
    )
    lines = (tmp_path / "result").read_text().splitlines()
    assert lines[0] == "sat"
    assert json.loads(lines[1]) == start


def test_an_instance_with_its_own_unsafe_set(folder, capsys):
    """A property under another name is taken as it stands."""
    safety = everywhere("line", TRACKS["square"], [[1.0, 0.0, 0.6499]])
    lower, upper = [0.65, 9.9, 0.0, 0.0], [0.85, 9.9, 0.0, 0.0]
    problem = question(zero_controller(5), lower, upper, steps=3, safety=safety)
    save(problem, folder, "own")
    _, out, _ = run(capsys, "verify", "own.json", "--json")
    answer = json.loads(out)
    assert answer["verdict"] == "unsat"
    assert 0 < answer["margin_lower"] <= 0.0001 + 1e-12


def test_matrices_are_multiplied_on_one_thread(folder, capsys):
    run(capsys, "verify", "nothing.json")
    assert all(pool["num_threads"] == 1 for pool in threadpool_info())

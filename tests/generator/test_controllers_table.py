"""The table of the trained controllers: against simulation by other means, and bad input."""

import csv
import hashlib
import json
import math

import pytest
from click.testing import CliRunner

from generator import controllers_command
from generator.cli import main
from generator.controllers_table import Runs, drive, make_row, trained_names
from generator.published import load_published
from racecar.cli import main as racecar
from racecar.errors import BadInput


@pytest.fixture
def root(tmp_path, add_controller):
    for index, seed in ((1, 0), (2, 1)):
        add_controller(tmp_path, f"TD3_L5_8_C{index}", seed=seed)
    return tmp_path


def run(root, *arguments):
    return CliRunner().invoke(main, ["controllers", "--root", str(root), *map(str, arguments)])


def test_a_row_says_what_record_curve_and_simulation_say(root):
    file, record = load_published(root, "TD3_L5_8_C2")
    row = make_row(file, record, drive(file, 300))
    record = json.loads((root / "onnx" / "TD3_L5_8_C2.json").read_text())
    assert (row.setup, row.rays, row.network, row.seed) == ("TD3_L5_8", 5, "8", 1)
    assert (row.steps, row.training_return, row.minutes) == (10_000, 900.25, 1.2)
    assert row.nominal_margin == record["nominal"]["margin"]
    assert row.smoothness == record["nominal"]["smoothness"]
    command = ["simulate", "--onnx", str(root / "onnx" / "TD3_L5_8_C2.onnx"), "--faults", "paper"]
    said = CliRunner().invoke(racecar, [*command, "--starts", "300", "--seed", "0", "--json"])
    simulated = json.loads(said.stdout)
    assert (row.paper_runs, row.paper_safe) == (300, simulated["safe"])
    low, high = row.paper_safe_interval
    assert low <= row.paper_safe_fraction <= high
    # Wilson's interval: its ends are where the share is 1.96 standard deviations off.
    for end in (low, high):
        if 0 < end < 1:
            off = abs(row.paper_safe_fraction - end) / math.sqrt(end * (1 - end) / 300)
            assert off == pytest.approx(1.95996, abs=1e-4)


@pytest.fixture
def driven(monkeypatch):
    """The names of the controllers that were simulated."""
    names = []

    def noted(file, *arguments):
        names.append(file.name)
        return drive(file, *arguments)

    monkeypatch.setattr(controllers_command, "drive", noted)
    return names


def cells(root):
    with (root / "benchmarks" / "controllers.csv").open() as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def test_the_command_prints_and_writes_a_row_each(root):
    result = run(root, "--runs", 50, "--json", "--write")
    assert result.exit_code == 0, result.output
    rows = [json.loads(x) for x in result.stdout.splitlines()]
    assert [x["name"] for x in rows] == ["TD3_L5_8_C1", "TD3_L5_8_C2"]
    assert [list(x["tried"][0]) for x in rows] == [["seed", "finishes_turn", "safe_fraction"]] * 2
    written = cells(root)
    assert list(written) == ["TD3_L5_8_C1", "TD3_L5_8_C2"]
    for row in rows:
        cell = written[row["name"]]
        content = (root / "onnx" / f"{row['name']}.onnx").read_bytes()
        assert cell["sha256"] == hashlib.sha256(content).hexdigest()
        assert cell["tried"] == "1"
        assert int(cell["paper_safe"]) == row["paper_safe"]
        assert float(cell["paper_safe_high"]) == row["paper_safe_interval"][1]
    shown = run(root, "TD3_L5_8_C2", "--runs", 50)
    assert "TD3_L5_8_C2" in shown.stdout
    assert "TD3_L5_8_C1" not in shown.stdout


def test_only_new_and_changed_controllers_are_simulated(root, driven, add_controller):
    first, second = "TD3_L5_8_C1", "TD3_L5_8_C2"
    write = ["--runs", 50, "--write"]
    assert run(root, second, *write).exit_code == 0
    assert (driven, list(cells(root))) == ([second], [second])
    assert run(root, *write).exit_code == 0
    assert (driven, list(cells(root))) == ([second, first], [first, second])
    before = (root / "benchmarks" / "controllers.csv").read_bytes()
    assert run(root, *write).exit_code == 0
    assert run(root, first, "--runs", 50).exit_code == 0
    assert driven == [second, first]
    assert (root / "benchmarks" / "controllers.csv").read_bytes() == before
    # Another network under the same name, and a record that says more.
    add_controller(root, second, seed=5)
    (root / "onnx" / f"{first}.curve.csv").write_text("timesteps,seconds\n5000,600\n")
    assert run(root, *write).exit_code == 0
    assert driven == [second, first, second]
    assert (cells(root)[first]["minutes"], cells(root)[first]["training_return"]) == ("10.0", "")
    assert run(root, first, "--runs", 60, "--write").exit_code == 0
    assert driven[3:] == [first]
    assert [x["paper_runs"] for x in cells(root).values()] == ["60", "50"]
    for path in (root / "onnx").glob(f"{first}*"):
        path.unlink()
    assert run(root, *write).exit_code == 0
    assert list(cells(root)) == [second]


def test_what_was_simulated_before_it_was_stopped_is_kept(root, driven, monkeypatch):
    def stopped(file, *arguments):
        if file.name.endswith("C2"):
            raise KeyboardInterrupt
        return Runs(50, 7)

    monkeypatch.setattr(controllers_command, "drive", stopped)
    assert run(root, "--runs", 50, "--write").exit_code != 0
    assert {name: x["paper_safe"] for name, x in cells(root).items()} == {"TD3_L5_8_C1": "7"}


def test_a_broken_table_is_refused_and_stays(root):
    path = root / "benchmarks" / "controllers.csv"
    assert run(root, "--runs", 50, "--write").exit_code == 0
    lines = path.read_text().splitlines()
    for broken in ("<<<<<<<", lines[2].replace(",50,", ",-1,"), lines[2].replace(",50,", ",x,")):
        text = "\n".join([*lines[:2], broken, ""])
        path.write_text(text)
        result = run(root, "--write")
        assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
        assert f"{path}, line 3: no row of the table" in result.stderr
        assert path.read_text() == text


def test_controllers_stand_by_setup(tmp_path, add_controller):
    names = ["ROBUST_L5_8_C1", "TD3_L5_8_C2", "TD3_L5_8_C10", "TD3_L5_16_C1", "TD3_L5_8relu_C1"]
    for name in reversed(names):
        add_controller(tmp_path, name)
    assert trained_names(tmp_path) == names


def test_bad_input_gives_one_line(root, tmp_path):
    folder = root / "onnx"
    cases = {"TD3_L5_8_C3": "C3.json", "TD3_L5_8_C1": "not a learning curve"}
    (folder / "TD3_L5_8_C1.curve.csv").write_text("a,b\n1,x\n")
    for name, message in cases.items():
        result = run(root, name)
        assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
        assert message in result.stderr
    (folder / "TD3_L5_8_C2.onnx").write_bytes((folder / "TD3_L5_8_C1.onnx").read_bytes())
    with pytest.raises(BadInput, match="not the record"):
        load_published(root, "TD3_L5_8_C2")
    assert run(tmp_path / "none").exit_code == 2

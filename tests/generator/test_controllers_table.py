"""The table of the trained controllers: against simulation by other means, and bad input."""

import csv
import json
import math

import pytest
from click.testing import CliRunner

from generator.cli import main
from generator.controllers_table import table_row, trained_names
from racecar.cli import main as racecar
from racecar.errors import BadInput

CURVE = "timesteps,episode_return,seconds\n5000,100.5,30.0\n10000,900.25,45.0\n"


@pytest.fixture
def root(tmp_path, add_controller):
    for index, seed in ((1, 0), (2, 1)):
        path = add_controller(tmp_path, f"TD3_L5_8_C{index}", seed=seed)
        path.with_suffix(".curve.csv").write_text(CURVE)
    return tmp_path


def run(root, *arguments):
    return CliRunner().invoke(main, ["controllers", "--root", str(root), *map(str, arguments)])


def test_a_row_says_what_record_curve_and_simulation_say(root):
    row = table_row(root, "TD3_L5_8_C2", runs=300)
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


def test_the_command_prints_and_writes_a_row_each(root):
    result = run(root, "--runs", 50, "--json", "-o", root / "table.csv")
    assert result.exit_code == 0, result.output
    rows = [json.loads(x) for x in result.stdout.splitlines()]
    assert [x["name"] for x in rows] == ["TD3_L5_8_C1", "TD3_L5_8_C2"]
    assert [list(x["tried"][0]) for x in rows] == [["seed", "finishes_turn", "safe_fraction"]] * 2
    with (root / "table.csv").open() as file:
        cells = list(csv.DictReader(file))
    assert [x["name"] for x in cells] == ["TD3_L5_8_C1", "TD3_L5_8_C2"]
    assert cells[0]["tried"] == "1"
    assert int(cells[0]["paper_safe"]) == rows[0]["paper_safe"]
    shown = run(root, "TD3_L5_8_C2", "--runs", 50)
    assert "TD3_L5_8_C2" in shown.stdout
    assert "TD3_L5_8_C1" not in shown.stdout


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
        table_row(root, "TD3_L5_8_C2")
    assert run(tmp_path / "none").exit_code == 2

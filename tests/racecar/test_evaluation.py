"""The scored protocol and Table 2: what they count, and that they come out the same again."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from racecar.bicycle import Bicycle
from racecar.cli import main
from racecar.closed_loop import Plant, State, simulate
from racecar.controller import load_controller
from racecar.evaluation import PROTOCOL, Evaluation, Protocol, evaluate
from racecar.experiment import Experiment, RandomStarts, run_experiment
from racecar.faultmodels.named import fault_names, named_faults
from racecar.faults import GivenFaults
from racecar.lidar import Lidar
from racecar.raysets import all_sets, drawn_sets, least_margins
from racecar.safety import named_property
from racecar.table2 import ENVIRONMENTS, PAPER, table_row
from racecar.track import square_track

ONNX = Path(__file__).parents[2] / "onnx"
TD3 = ONNX / "TD3_L21_64x64_C1.onnx"
PLANT = Plant(square_track(), Bicycle(), Lidar())
SMALL = Protocol(1, ("paper_pattern", "reflective"), 60, 3, 11, (0.75,))


@pytest.fixture(scope="module")
def steer():
    return load_controller(TD3).steering_rows


@pytest.fixture(scope="module")
def small(steer):
    return evaluate(steer, 21, "c", "0" * 64, protocol=SMALL)


def test_the_score_is_the_mean_share_of_runs_safe_at_all_times(small, steer):
    safe = []
    for name in SMALL.scored:
        safety = named_property("clearance", PLANT.track)
        experiment = Experiment(PLANT, safety, RandomStarts(), named_faults(name), 60, seed=3)
        safe.append(int(run_experiment(experiment, steer).safe_continuous.sum()))
    assert [x.continuous.safe for x in small.scenarios] == safe
    assert small.score == pytest.approx(100 * np.mean(safe) / 60)
    assert small.nominal.continuous.fraction == 1.0
    low, high = small.scenarios[0].continuous.interval
    assert low < safe[0] / 60 < high


def test_sets_of_rays_are_all_tried(small, steer):
    single, pair = small.ray_sets
    assert (single.sets, pair.sets) == (21, 210)
    gone = np.zeros((21, 1), dtype=bool)
    gone[list(pair.worst)] = True
    safety = named_property("clearance", PLANT.track)
    faults = GivenFaults(1.5, 5.0, gone)
    runs = simulate(PLANT, steer, safety, State.start([0.75]), 70, faults)
    assert runs.margin[0] == pytest.approx(pair.margin_min, abs=1e-9)


def test_every_set_comes_once():
    found = {tuple(np.flatnonzero(column)) for column in all_sets(6, 3).T}
    assert found == set(combinations(range(6), 3))
    assert all_sets(6, 0).shape == (6, 1)
    drawn = drawn_sets(21, 5, 400, np.random.default_rng(0))
    assert drawn.shape == (21, 400)
    assert 1 <= drawn.sum(axis=0).min() <= drawn.sum(axis=0).max() == 5


def test_no_missing_ray_leaves_the_nominal_margin(steer):
    safety = named_property("clearance", PLANT.track)
    runs = simulate(PLANT, steer, safety, State.start([0.75]), 70)
    assert least_margins(PLANT, steer, all_sets(21, 0), (0.75,))[0] == runs.margin[0]


def test_a_controller_that_answers_nan_is_never_safe():
    found = evaluate(lambda scan: np.full(scan.shape[1], np.nan), 21, "c", "0" * 64, protocol=SMALL)
    assert found.score == 0.0
    assert all(x.margin_min < 0 for x in found.scenarios)


def test_the_hash_changes_with_whatever_the_protocol_says():
    others = [
        SMALL.__class__(**(vars(SMALL) | change))
        for change in (
            {"runs": 61}, {"seed": 4}, {"scored": ("paper_pattern",)}, {"ray_starts": (0.7,)},
            {"nominal_runs": 12}, {"version": 2},
        )
    ]  # fmt: skip
    assert len({x.sha256() for x in [SMALL, *others]}) == 7


def test_the_published_protocol_does_not_change_unnoticed():
    """Results in the world carry this hash: a change needs a new version, and a new hash here."""
    assert PROTOCOL.version == 1
    assert PROTOCOL.sha256() == "9d28ce6c0bb0fd8ff45d9ee8d8171b506c10f3683fbe71b3e4249e41a92f3003"
    assert set(PROTOCOL.scored) == set(fault_names())


def test_workers_do_not_change_an_outcome(steer):
    safety = named_property("clearance", PLANT.track)
    experiment = Experiment(
        PLANT, safety, RandomStarts(), named_faults("mixture"), 1300, steps=8, seed=9
    )
    alone = run_experiment(experiment, steer)
    with ThreadPoolExecutor(3) as pool:
        together = run_experiment(experiment, steer, map_blocks=pool.map)
    assert (alone.runs.margin == together.runs.margin).all()


def test_table_2_has_the_papers_numbers_and_the_models(steer):
    row = table_row(steer, 21, "TD3_L21_64x64_C1", 50, 0)
    assert [x.environment for x in row] == list(ENVIRONMENTS)
    assert [x.paper for x in row] == [8, 9]
    assert all(0 <= x.interval[0] <= x.safe / 50 <= x.interval[1] <= 1 for x in row)
    assert table_row(steer, 21, "mine", 5, 0)[0].paper is None
    # The totals of the paper's columns: about 10 % of the runs with covered walls were unsafe.
    assert len(PAPER) == 12
    assert [sum(x) for x in zip(*PAPER.values(), strict=True)] == [109, 76]


def run(*arguments):
    return CliRunner().invoke(main, [str(x) for x in arguments])


def test_the_command_writes_a_result_that_reads_back(tmp_path):
    output = tmp_path / "result.json"
    result = run("evaluate", TD3, "--runs", 3, "-o", output, "--json")
    assert result.exit_code == 0, result.output
    read = Evaluation.model_validate_json(output.read_text())
    assert json.loads(result.stdout) == json.loads(output.read_text())
    assert not read.official
    assert read.protocol_sha256 == PROTOCOL.sha256()
    shown = run("evaluate", TD3, "--runs", 3)
    assert "not to be compared" in shown.stdout
    assert f"score {read.score:.2f}" in shown.stdout


def test_the_commands_say_what_is_wrong(tmp_path):
    for arguments in (
        ("evaluate", tmp_path / "none.onnx"),
        ("table2",),
        ("table2", tmp_path / "none.onnx"),
        ("faults", "unheard_of"),
        ("faults", "paper"),
        ("simulate", "--onnx", TD3, "--faults", "block", "--noise", 0.1),
        ("plot", "--figure", 4, "-o", tmp_path / "x.png"),
        ("plot", TD3, "-o", tmp_path / "x.png"),
        ("plot", "--figure", 3, "--steps", 9, "-o", tmp_path / "x.png"),
    ):
        result = run(*arguments)
        assert result.exit_code == 2, arguments
        assert result.stderr.count("\n") == 1, result.stderr
    assert list(tmp_path.iterdir()) == []


def test_table_2_and_the_fault_models_are_printed():
    result = run("table2", TD3, "--runs", 4, "--json")
    record = json.loads(result.stdout)
    assert record["controller"] == "TD3_L21_64x64_C1"
    assert [x["paper"] for x in record["entries"]] == [8, 9]
    assert "TD3_L21_64x64_C1" in run("table2", TD3, "--runs", 4).stdout
    assert [line.split()[0] for line in run("faults").stdout.splitlines()] == list(fault_names())
    assert json.loads(run("faults", "block").stdout)["name"] == "block"
    assert json.loads(run("faults", "--schema").stdout)["title"] == "FaultSpec"


@pytest.mark.parametrize("number", [3, 4, 5])
def test_the_papers_figures_are_drawn(tmp_path, number):
    file = tmp_path / "f.png"
    result = run("plot", "--figure", number, TD3, TD3, "--starts", 3, "-o", file, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["figure"] == number
    assert file.read_bytes().startswith(b"\x89PNG")


def test_simulate_takes_models_by_name_and_file(tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(run("faults", "block").stdout)
    records = [
        json.loads(run("simulate", "--onnx", TD3, "--faults", x, "--starts", 40, "--json").stdout)
        for x in ("block", file)
    ]
    assert records[0]["faults"] == "block"
    assert records[0]["faults_sha256"] == named_faults("block").sha256()
    assert [r["margin_min"] for r in records] == [records[0]["margin_min"]] * 2

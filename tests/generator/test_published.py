"""The quick category asks what simulation answers clearly; the committed files are current."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from generator.cli import main
from generator.seeds import file_sha256
from racecar.closed_loop import State, simulate
from racecar.controller import load_controller
from racecar.instance import load_instance, load_instance_controller

CHECKOUT = Path(__file__).parents[2]
FOLDER = CHECKOUT / "benchmarks" / "quick"
CLEAR = 0.02


def margins(path, starts=2001):
    instance = load_instance(path)
    controller = load_instance_controller(instance, path)
    lower, upper = instance.initial_set.bounds()
    share = np.linspace(0, 1, starts)[:, None]
    s, f, v, theta = ((1 - share) * lower + share * upper).T
    start = State.start(s, f, v, theta)
    safety = instance.make_property()
    steer = controller.steering_rows
    return simulate(instance.make_plant(), steer, safety, start, instance.steps)


@pytest.fixture(scope="module")
def outcomes():
    return {path.stem: margins(path) for path in sorted((FOLDER / "json").iterdir())}


def test_every_answer_is_clear_by_more_than_two_centimetres(outcomes):
    least = {name: runs.margin.min() for name, runs in outcomes.items()}
    assert {name: x for name, x in least.items() if -CLEAR < x < CLEAR} == {}


def test_both_answers_horizons_controllers_and_properties_are_mixed(outcomes):
    safe = {name for name, runs in outcomes.items() if runs.margin.min() > 0}
    assert len(safe) >= 5
    assert len(outcomes) - len(safe) >= 5
    instances = {name: load_instance(FOLDER / "json" / f"{name}.json") for name in outcomes}
    for group in (safe, set(outcomes) - safe):
        assert {instances[name].steps for name in group} >= {5, 10, 20, 70}
        assert len({instances[name].controller.name for name in group}) == 2
        assert {instances[name].property.name for name in group} == {"clearance", "hscc20"}


def test_some_unsafe_behaviour_shows_only_between_control_instants(outcomes):
    assert any(
        runs.margin.min() <= -CLEAR and runs.margin_sampled.min() > 0 for runs in outcomes.values()
    )


def test_the_committed_files_are_current():
    result = CliRunner().invoke(main, ["emit", "--check"])
    assert (result.exit_code, result.output) == (0, "all emitted files are current\n")


def test_the_documentation_reads_an_instance_without_this_package():
    text = (CHECKOUT / "docs" / "categories.md").read_text()
    section = text.partition("## Reading an instance without this package\n")[2].partition("\n##")[
        0
    ]
    code = "\n".join(x[4:] for x in section.splitlines() if x.startswith("    "))
    end = "\nimport sys; assert not {'racecar', 'generator'} & set(sys.modules)"
    command = [sys.executable, "-c", code + end]
    said = subprocess.run(command, cwd=CHECKOUT, check=True, capture_output=True, text=True).stdout
    *_, steps, steering = said.split()
    assert said.startswith("TD3_L21_64x64_C1.quick.drive70.clearance [0.77, 0.775]")
    controller = load_controller(CHECKOUT / "onnx" / "TD3_L21_64x64_C1.onnx")
    wanted = controller.steering(np.full((1, 21), 2.0))[0]
    assert (int(steps), float(steering)) == (70, pytest.approx(wanted, abs=1e-6))


@pytest.mark.parametrize("name", ["TD3_L21_64x64_C1", "DDPG_L21_64x64_C1"])
def test_committed_controllers_drive_as_their_records_say(name):
    from generator.nominal import drive_nominal
    from generator.record import ControllerRecord, load_record
    from racecar.experiment import default_field_of_view

    record = load_record(CHECKOUT / "onnx" / f"{name}.json", ControllerRecord)
    path = CHECKOUT / "onnx" / f"{name}.onnx"
    assert file_sha256(path) == record.sha256
    nominal = drive_nominal(load_controller(path), default_field_of_view(21))
    assert nominal.margin == pytest.approx(record.nominal.margin, abs=1e-6)
    assert nominal.label == record.label == "safe"
    assert nominal.finishes_turn

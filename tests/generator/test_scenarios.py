"""Scenario files: what is read back drives as the model does, and says what it holds."""

import math

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from generator.cli import main
from generator.instances import benchmark_plant
from generator.scenarios import load_scenarios, make_scenarios
from racecar.closed_loop import simulate
from racecar.errors import BadInput
from racecar.experiment import Experiment, RandomStarts, run_experiment
from racecar.faultmodels.named import fault_names, named_faults
from racecar.safety import named_property

PLANT = benchmark_plant(21, math.radians(230))


def steer(scan):
    """Keep to the middle by two rays at the sides."""
    return np.clip(0.1 * (scan[15] - scan[5]), -0.26, 0.26)


@pytest.mark.parametrize("name", fault_names())
def test_runs_of_a_file_are_those_of_the_model(tmp_path, name):
    path, model = tmp_path / "s.h5", named_faults(name)
    path.write_bytes(make_scenarios(model, PLANT, 12, 50, 7))
    read, start, scenario = load_scenarios(path, PLANT)
    assert read == model
    safety = named_property("clearance", PLANT.track)
    found = simulate(PLANT, steer, safety, start, 50, scenario)
    experiment = Experiment(PLANT, safety, RandomStarts(), model, 12, 50, 7)
    expected = run_experiment(experiment, steer)
    assert (found.margin == expected.runs.margin).all()
    assert (start.s == expected.start.s).all()


def test_every_dataset_has_units_and_a_description_and_bytes_do_not_vary(tmp_path):
    first = make_scenarios(named_faults("mixture"), PLANT, 3, 4, 0)
    assert first == make_scenarios(named_faults("mixture"), PLANT, 3, 4, 0)
    path = tmp_path / "s.h5"
    path.write_bytes(first)
    seen = []
    with h5py.File(path) as file:
        file.visititems(lambda name, item: seen.append((name, dict(item.attrs))))
    assert {"s", "part_0/noise"} <= {name for name, _ in seen}
    assert all(x["units"] and x["description"] for _, x in seen)


def test_the_command_writes_a_file_and_refuses_what_it_cannot(tmp_path):
    path = tmp_path / "s.h5"
    run = CliRunner().invoke(main, ["scenarios", "block", "--runs", "2", "-o", str(path)])
    assert run.exit_code == 0, run.output
    assert load_scenarios(path, PLANT)[0].name == "block"
    for wrong in (["paper"], ["block", "--runs", "5000"]):
        assert CliRunner().invoke(main, ["scenarios", *wrong, "-o", str(path)]).exit_code == 2
    path.write_bytes(b"no")
    with pytest.raises(BadInput, match="cannot be read"):
        load_scenarios(path, PLANT)

"""Small instances and the traces that the simulator gives for them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from generator.actor import fold
from generator.instances import ControllerFile, Question, make_instance
from racecar.closed_loop import State, simulate
from racecar.controller import load_controller, save_controller
from racecar.instance import load_instance, load_instance_controller, parse_instance
from racecar.polygon import Polygon
from racecar.safety import Property

CHECKOUT = Path(__file__).parents[3]


def _small(slope="tanh"):
    """A network of 5 rays and 3 neurons that drives the turn, found by random search."""
    return fold(
        [
            (
                [
                    [1.41, -2.38, -0.34, 0.22, 1.35],
                    [-1.55, 0.57, 1.78, -1.02, 0.04],
                    [-0.16, -1.08, 0.54, 0.37, 1.37],
                ],
                [0.52, -0.66, 0.13],
                slope,
            ),
            ([[3.72, 1.25, 1.78]], [-0.77], "tanh"),
        ],
        {},
    )


@pytest.fixture(scope="session")
def small():
    return _small()


@pytest.fixture(scope="session")
def make_small(tmp_path_factory, small):
    """make_small(controller=..., change=..., **question) returns (instance, controller)."""
    folder = tmp_path_factory.mktemp("hybrid")

    def make(controller=small, change=None, **question):
        path = folder / "small.onnx"
        save_controller(controller, path)
        wanted = {"id": "small", "category": "test", "start": ("0.65", "0.85")} | question
        file = ControllerFile(path, path.read_bytes(), load_controller(path))
        made = make_instance(Question(**wanted), file, math.radians(230), folder / "small.json")
        if change:
            data = made.model_dump(mode="json")
            change(data)
            made = parse_instance(json.dumps(data), "changed")
        return made, file.controller

    return make


@pytest.fixture(scope="session")
def committed():
    """Return the committed full-range instance of TD3_L21_64x64_C1 and its controller."""
    path = CHECKOUT / "benchmarks/full_range/json/TD3_L21_64x64_C1.full_range.clearance.json"
    instance = load_instance(path)
    return instance, load_instance_controller(instance, path)


def traced(instance, controller, s, disturb=None, **start):
    """Return the simulated trace from one start: arrays ``[steps + 1]`` by name.

    A run is not cut where it becomes unsafe: an automaton goes on as well.
    """
    given = {"f": instance.initial_set.f[0], "v": instance.initial_set.v[0]} | start
    nowhere = Polygon.from_constraints([[1.0, 0.0, -1e6]])
    runs = simulate(
        instance.make_plant(),
        controller.steering_rows,
        Property("nowhere", ((nowhere,),) * len(instance.plant.frames)),
        State.start(s, **given),
        instance.steps,
        disturb,
        record=True,
    )
    assert (runs.crash_step < 0).all()
    return {name: values[0] for name, values in runs.trace.items()}


@pytest.fixture(scope="session")
def trace():
    return traced


@pytest.fixture(scope="session")
def beside_jumps(make_small):
    """Return values of f, 0.1 mm apart, from which a ray first meets different walls, s = 0.75."""
    instance, controller = make_small()
    plant = instance.make_plant()
    starts = np.linspace(9.8, 10.0, 2001)
    state, pairs, seen = State.start(0.75, starts), [], np.zeros(2000, dtype=bool)
    for _ in range(instance.steps):
        scan = plant.scan_rows(state)
        jumps = np.abs(np.diff(scan, axis=1)).max(axis=0)
        # After its first jump a pair is apart, and no pair of neighbours any more.
        for i in np.flatnonzero((jumps > 0.05) & ~seen):
            pairs.append((float(starts[i]), float(starts[i + 1])))
        seen |= jumps > 0.05
        state = plant.advance(plant.drive(state, controller.steering_rows(scan))[0])
    assert pairs
    return pairs[0]

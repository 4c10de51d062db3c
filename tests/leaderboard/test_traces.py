"""Runs for pictures: the same as the simulator's and the judge's, and what is allowed."""

import math

import numpy as np
import pytest
from site_helpers import CLOSE, DRIVE, ROOT, WITNESS

from harness.given import complaint
from harness.replay import Replayer
from leaderboard.scene import scene
from leaderboard.traces import (
    DISTURBED,
    FEW,
    MANY,
    cut,
    drive,
    fits,
    given_faults,
    sample_faults,
    sample_starts,
    witness_starts,
)
from racecar.closed_loop import State, simulate
from racecar.controller import RuntimeSteer
from racecar.disturbance import Disturbance, Mirrors
from racecar.faultmodels.spec import Segment
from racecar.instance import InitialSet, controller_path, load_instance
from racecar.witness import Witness


def load(name):
    spec = ROOT / f"quick/json/{name}.json"
    instance = load_instance(spec)
    return instance, spec, RuntimeSteer(controller_path(instance, spec))


def disturbed(**change):
    instance, _, steer = load(DRIVE)
    values = {"noise": 0.0, "missing": 0, "turn_only": False, "choice": "run"} | change
    return instance.model_copy(update={"disturbance": Disturbance(**values)}), steer


def test_traces_are_the_simulators():
    instance, _, steer = load(DRIVE)
    plant, safety = instance.make_plant(), instance.make_property()
    starts = np.array([[0.771, 9.9, 0.0, 0.0], [0.1, 9.9, 0.0, 0.0]])
    good, bad = drive(plant, steer, safety, starts, instance.steps)
    runs = simulate(plant, steer, safety, State.start(*starts.T), instance.steps)
    least = min(good.margin.min(), good.least.min())
    assert least == pytest.approx(runs.margin[0], abs=1e-12)
    assert len(good.x) == instance.steps + 1 == len(good.steering) + 1
    assert not good.crashed
    # The second begins 0.1 m from the wall, where 0.3 m are asked for.
    assert bad.crashed
    assert len(bad.x) == 1
    assert bad.margin[0] == pytest.approx(-0.2)
    # The first hall runs along +x; its left front corner is the origin.
    assert (good.x[0], good.y[0]) == pytest.approx((-9.9, -0.771))


def test_a_witness_is_driven_as_the_judge_drives_it():
    instance, spec, _ = load(CLOSE)
    witness = Witness(**WITNESS)
    assert fits(instance, witness)
    plant, safety = instance.make_plant(), instance.make_property()
    steer = RuntimeSteer(controller_path(instance, spec))
    (trace,) = drive(plant, steer, safety, witness_starts([witness]), instance.steps)
    expected = Replayer(instance, spec).margin(witness)
    assert min([*trace.margin, *trace.least]) == pytest.approx(expected, abs=1e-9)
    assert trace.crashed


@pytest.mark.parametrize(
    ("box", "count"),
    [
        ({"s": (0.65, 0.655)}, FEW),
        ({"s": (0.65, 0.85)}, MANY),
        ({"s": (0.65, 0.65)}, 1),
        ({"s": (0.65, 0.85), "v": (0.0, 1.0)}, 5),
    ],
)
def test_starts_lie_in_the_box_and_reach_its_ends(box, count):
    values = {"s": (0.7, 0.7), "f": (9.9, 9.9), "v": (0.0, 0.0), "theta": (0.0, 0.0)} | box
    initial = InitialSet(**values)
    starts = sample_starts(initial)
    lower, upper = initial.bounds()
    assert starts.shape == (count, 4)
    assert (starts >= lower).all()
    assert (starts <= upper).all()
    assert (starts.min(axis=0) == lower).all()
    assert (starts.max(axis=0) == upper).all()


@pytest.mark.parametrize("choice", ["run", "step"])
def test_sampled_disturbances_are_allowed(choice):
    instance, _ = disturbed(noise=0.01, missing=2, choice=choice)
    faults = sample_faults(instance.disturbance, instance.make_plant(), 70, ["one", "two"])
    assert np.abs(faults.noise).max() <= 0.01
    assert faults.gone.sum(axis=-2).max() == 2
    assert not faults.gone[..., [0, DISTURBED]].any()  # the first of each is undisturbed
    again = sample_faults(instance.disturbance, instance.make_plant(), 70, ["two"])
    assert (again.gone == faults.gone[..., DISTURBED:]).all()
    assert (again.noise == faults.noise[..., DISTURBED:]).all()


def test_missing_rays_are_told_where_they_are_missing():
    instance, steer = disturbed(missing=1, turn_only=True)
    witness = Witness(s=0.771, f=9.9, v=0, theta=0, missing=[10])
    assert complaint(instance, witness) is None
    faults = given_faults(instance, [witness])
    plant, safety = instance.make_plant(), instance.make_property()
    (trace,) = drive(plant, steer, safety, witness_starts([witness]), 70, faults)
    # In the first hall x is -f: the turn begins 1 m before the corner square of 1.5 m.
    for x, rays in zip(trace.x, trace.missing, strict=False):
        if x < -2.5:
            assert rays == []
    assert [10] in trace.missing


#: The left wall of the first hall: 1 to 2 m and 2 to 3 m before the corner.
WALLS = Mirrors(
    segments=tuple(Segment(hall=0, begin=(0.0, a), end=(0.0, a + 1.0)) for a in (1.0, 2.0)),
    incidence=math.radians(45),
)


def test_rays_that_a_mirror_takes_are_told_and_the_stretch_is_drawn():
    instance, steer = disturbed(mirrors=WALLS)
    witnesses = [Witness(s=0.771, f=9.9, v=0, theta=0, mirror=mirror) for mirror in (None, 1)]
    assert all(fits(instance, witness) for witness in witnesses)
    assert not fits(instance, Witness(s=0.771, f=9.9, v=0, theta=0, mirror=2))
    faults = given_faults(instance, witnesses)
    plant, safety = instance.make_plant(), instance.make_property()
    none, one = drive(plant, steer, safety, witness_starts(witnesses), 70, faults)
    assert (none.mirror, one.mirror) == (None, 1)
    assert not any(none.missing)
    # In the plane that wall is y = 0, from x = -3 to x = -2.
    taken = 0
    for x, y, heading, rays in zip(one.x, one.y, one.heading, one.missing, strict=False):
        expected = []
        for ray, angle in enumerate(heading + plant.lidar.angles):
            if math.sin(angle) <= 0 or -y / math.sin(angle) >= 5:
                continue
            if -3 <= x - y / math.tan(angle) <= -2 and abs(math.tan(angle)) < 1:
                expected.append(ray)
        assert rays == expected
        taken += len(rays)
    assert taken > 5
    picture = scene(plant, safety, [none, one], ("tool", one), None, WALLS.segments)
    assert picture["mirrors"] == [[[-1.0, 0.0], [-2.0, 0.0]], [[-2.0, 0.0], [-3.0, 0.0]]]
    assert [run.get("mirror") for run in picture["traces"]] == [None, 1]
    assert picture["witness"]["mirror"] == 1


def test_sampled_runs_have_mirrors_but_the_first():
    instance, _ = disturbed(mirrors=WALLS)
    faults = sample_faults(instance.disturbance, instance.make_plant(), 70, ["one", "two"])
    chosen = faults.mirrors.chosen
    assert (np.flatnonzero(chosen < 0) == [0, DISTURBED]).all()
    assert set(chosen) == {-1, 0, 1}


def test_a_witness_that_ends_early_is_drawn_until_then():
    instance, steer = disturbed(noise=0.01)
    quiet = [[0.0] * 21] * 30
    witness = Witness(s=0.771, f=9.9, v=0, theta=0, noise=quiet)
    faults = given_faults(instance, [witness])
    plant, safety = instance.make_plant(), instance.make_property()
    (trace,) = drive(plant, steer, safety, witness_starts([witness]), 70, faults)
    short = cut(trace, 30)
    assert len(short.x) == 31
    assert len(short.steering) == 30
    # No noise: as if nothing disturbed it.
    (free,) = drive(plant, steer, safety, witness_starts([witness]), 30)
    assert short.y == pytest.approx(free.y, abs=1e-9)


def test_a_witness_of_the_wrong_shape_is_not_drawn():
    instance, _, _ = load(DRIVE)
    assert not fits(instance, Witness(s=0.771, f=9.9, v=0, theta=0, missing=[3]))

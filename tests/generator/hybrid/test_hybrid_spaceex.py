"""SpaceEx models: read back with an XML parser and Hyst's expression grammar, and run."""

import math

import numpy as np
import pytest
from hybrid_readers import read_spaceex
from hybrid_runner import Runner, periods

from generator.hybrid.native import native_automaton
from generator.hybrid.polynomial import polynomial_automaton
from generator.hybrid.spaceex import ranges_apart, spaceex_cfg, spaceex_xml
from racecar.errors import BadInput
from racecar.faults import GivenFaults


def printed(instance, controller):
    automaton = polynomial_automaton(instance, controller)
    return spaceex_xml(automaton).text(), spaceex_cfg(automaton).text()


@pytest.fixture(scope="module")
def read(make_small):
    return read_spaceex(*printed(*make_small()))


def test_a_read_model_drives_the_simulated_trace_on_both_sides_of_a_wall_jump(
    read, make_small, trace, beside_jumps
):
    instance, controller = make_small()
    runner = Runner(read)
    for f in beside_jumps:
        simulated = trace(instance, controller, 0.75, f=f)
        start = runner.middle(s=0.75, f=f)
        for k, values in enumerate(periods(runner.run(start))):
            for name in ("s", "f", "v"):
                assert values[name] == pytest.approx(simulated[name][k], abs=1e-6)
        assert k == 70


def test_every_location_states_the_derivative_of_every_variable(read):
    # One that is left out may change freely in SpaceEx.
    for flow in read.flows.values():
        assert list(flow) == read.variables


def test_the_start_box_and_the_horizon_are_the_instances(read, make_small):
    instance, _ = make_small()
    assert read.initial_mode == "begin"
    assert list(read.initial) == read.variables
    assert read.initial["s"] == (0.65, 0.85)
    assert read.initial["f"] == (9.9, 9.9)
    # The first mode lasts a unit of time; each period has one to divide, two layers and tan.
    spent = 1 + instance.steps * (4 + 0.1)
    assert spent + 0.5 < float(read.text["time-horizon"]) < spent + 2


def test_forbidden_holds_every_polygon_of_the_property(read, make_small):
    instance, _ = make_small()
    assert {mode for mode, _ in read.unsafe} == {"drive"}
    polygons = instance.make_property().unsafe[0]
    assert len(read.unsafe) == len(polygons)
    runner = Runner(read)
    for s, f in np.random.default_rng(1).uniform([-0.5, -0.5], [21, 21], size=(300, 2)):
        values = runner.middle(s=s, f=f)
        names = {"v": values}
        inside = [
            all(_holds(eval(left, names), relation, bound) for left, relation, bound in rows)
            for _, rows in read.unsafe
        ]
        assert inside == [p.separation(s, f) <= 0 for p in polygons]


def _holds(value, relation, bound):
    return {"<=": value <= bound, ">=": value >= bound}[relation]


@pytest.fixture(scope="module")
def disturbed(make_small):
    def change(data):
        data["disturbance"] = {"noise": 0.04, "missing": 2, "turn_only": True, "choice": "step"}

    return make_small(change=change, front="2.6", speed="2.2", steps=6)


def test_noise_and_missing_rays_are_any_choice_of_the_runner(disturbed, trace):
    instance, controller = disturbed
    rays, steps = 5, instance.steps
    random = np.random.default_rng(3)
    noise = random.uniform(-0.04, 0.04, size=(steps, rays, 1))
    gone = np.zeros((steps, rays, 1), dtype=bool)
    gone[:, [1, 3]] = True
    faults = GivenFaults(1.5, 5.0, gone, True, noise)
    simulated = trace(instance, controller, 0.75, faults)
    assert (simulated["f"][:-1] > 2.5).any()
    assert (simulated["f"][:-1] < 2.5).any()  # outside the turn, then in it
    runner = Runner(read_spaceex(*printed(instance, controller)))

    def choose(ways, values):
        # A ray is missing if it may be and is on the list: that jump counts it.
        counts = [edge for edge, _ in ways if "gone" in edge.reset and "turn" not in edge.reset]
        for edge, reset in ways:
            ray = edge.source.removeprefix("disturb_")
            if edge in counts and ray.isdigit() and edge.source.startswith("disturb_"):
                if gone[int(values["k"]), int(ray) - 1, 0]:
                    return edge, reset
            else:
                return edge, reset
        raise AssertionError("no way on")

    def spread(name, low, high):
        assert (low, high) == (-0.04, 0.04)
        step = int(seen["k"])
        return float(noise[step, int(name.removeprefix("e_h")) - 1, 0])

    seen = {"k": 0}

    def follow():
        for mode, values in runner.run(runner.middle(s=0.75), None, choose, spread):
            seen.update(values)
            yield mode, values

    for k, values in enumerate(periods(follow())):
        for name in ("s", "f", "v"):
            assert values[name] == pytest.approx(simulated[name][k], abs=1e-8), (k, name)
    assert k == steps


def test_a_reset_to_a_range_is_one_of_constants(disturbed):
    read = read_spaceex(*printed(*disturbed))
    ranged = [edge for edge in read.edges if edge.ranges]
    assert ranged
    for edge in ranged:
        assert all(edge.reset[name] == "0.0" for name in edge.ranges)


def test_without_ranges_nothing_is_added(make_small):
    automaton = polynomial_automaton(*make_small())
    assert ranges_apart(automaton) is automaton


def test_functions_that_spaceex_lacks_are_refused(make_small):
    with pytest.raises(BadInput, match="SpaceEx has no function tanh"):
        spaceex_xml(native_automaton(*make_small())).text()


def test_text_with_markup_in_it_is_escaped(make_small):
    instance, controller = make_small(id="a--b")
    xml, _ = printed(instance, controller)
    comments = [part.split("-->")[0] for part in xml.split("<!--")[1:]]
    assert comments
    assert not any("--" in comment for comment in comments)
    assert math.isfinite(len(xml))

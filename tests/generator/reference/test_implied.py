"""A proof carries over only to questions that ask less."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from generator.reference.implied import (
    disturbs_no_more,
    implies,
    starts_within,
    unsafe_within,
)
from racecar.disturbance import Disturbance
from racecar.instance import InitialSet, load_instance, property_data
from racecar.polygon import Polygon
from racecar.safety import margin, named_property
from racecar.track import square_track

ROOT = Path(__file__).resolve().parents[3] / "benchmarks"
NAME = "TD3_L21_64x64_C1"
CLEARANCE, HSCC20 = (
    property_data(named_property(name, square_track())) for name in ("clearance", "hscc20")
)


def instance(category, rest):
    return load_instance(ROOT / category / "json" / f"{NAME}.{category}.{rest}.json")


def changed(data, **update):
    return data.model_copy(update=update)


@pytest.fixture(scope="module")
def whole():
    return instance("full_range", "clearance")


def test_the_whole_range_implies_its_subsets_and_the_weaker_property(whole):
    part = instance("closed_loop", "w5mm.000.clearance")
    assert implies(whole, part)
    assert implies(whole, instance("full_range", "hscc20"))
    assert not implies(part, whole)
    assert not implies(instance("full_range", "hscc20"), whole)


def test_nothing_carries_over_to_another_network_plant_or_longer_run(whole):
    other = changed(whole.controller, sha256="0" * 64)
    assert implies(whole, changed(whole, steps=69))
    assert not implies(whole, changed(whole, steps=71))
    assert not implies(whole, changed(whole, controller=other))
    assert not implies(whole, changed(whole, plant=changed(whole.plant, period=0.2)))


def test_a_start_set_that_sticks_out_by_one_double_is_not_contained(whole):
    low, high = whole.initial_set.s
    for bounds in ((np.nextafter(low, 0), high), (low, np.nextafter(high, 1))):
        wider = changed(whole.initial_set, s=tuple(map(float, bounds)))
        assert not starts_within(wider, whole.initial_set)
        assert starts_within(whole.initial_set, wider)


def test_a_proof_under_disturbance_holds_without_it(whole):
    noisy = changed(whole, disturbance=disturbance(noise=0.01))
    assert implies(noisy, whole)
    assert not implies(whole, noisy)


def disturbance(noise=0.0, missing=0, turn_only=False, choice="run"):
    return Disturbance(noise=noise, missing=missing, turn_only=turn_only, choice=choice)


def histories(allowed, rays=2, turns=(False, True)):
    """All that a disturbance may do in two steps, the second one in the turn: rays missing."""
    sets = [frozenset(s) for s in ((), (0,), (1,), (0, 1)) if len(s) <= allowed.missing]

    def shown(chosen):
        return tuple(
            c if turn or not allowed.turn_only else frozenset()
            for c, turn in zip(chosen, turns, strict=True)
        )

    if allowed.choice == "run":
        return {shown((c, c)) for c in sets}
    return {shown((c, d)) for c in sets for d in sets}


missing_rays = st.builds(
    disturbance,
    noise=st.just(0.01),
    missing=st.integers(0, 2),
    turn_only=st.booleans(),
    choice=st.sampled_from(["run", "step"]),
)


@given(missing_rays, missing_rays)
def test_what_disturbs_no_more_has_no_other_histories(less, more):
    if disturbs_no_more(less, more):
        assert histories(less) <= histories(more)


@given(st.floats(0.001, 0.1), st.floats(0.001, 0.1))
def test_less_noise_disturbs_less(a, b):
    assert disturbs_no_more(disturbance(noise=a), disturbance(noise=b)) == (a <= b)


def test_the_paper_s_unsafe_set_lies_within_clearance_s_and_not_the_other_way():
    assert unsafe_within(HSCC20, CLEARANCE)
    assert not unsafe_within(CLEARANCE, HSCC20)


@given(st.lists(st.tuples(st.floats(-1, 21), st.floats(-1, 21)), min_size=1, max_size=50))
def test_margins_are_no_smaller_for_the_set_that_lies_within(points):
    s, f = np.array(points).T
    smaller, larger = (
        [Polygon.from_constraints(p) for p in data.unsafe[0]] for data in (HSCC20, CLEARANCE)
    )
    assert (margin(smaller, s, f) >= margin(larger, s, f)).all()


boxes = st.lists(st.integers(0, 8), min_size=8, max_size=8).map(
    lambda n: InitialSet.model_validate(
        {
            k: [min(a, b) / 8, max(a, b) / 8]
            for k, a, b in zip(("s", "f", "v", "theta"), n[:4], n[4:], strict=True)
        }
    )
)


@given(boxes, boxes, st.lists(st.floats(0, 1), min_size=4, max_size=4))
def test_sampled_starts_of_an_inner_box_lie_in_the_outer_one(inner, outer, where):
    if starts_within(inner, outer):
        low, high = inner.bounds()
        start = np.clip(low + np.array(where) * (high - low), low, high)
        least, most = outer.bounds()
        assert (least <= start).all()
        assert (start <= most).all()

"""The proved margin of a step is never above the exact margin of a car in the row."""

from __future__ import annotations

import math

import numpy as np
import pytest
from enclosed import cars, one_row
from hypothesis import example, given, settings
from hypothesis import strategies as st

from racecar.bicycle import Bicycle
from racecar.polygon import Polygon
from racecar.safety import arc_margin, named_property
from racecar.track import square_track
from verifier.clearance import PIECES, least_margin
from verifier.models import TERMS, Models
from verifier.motion import Motion
from verifier.rows import THETA, F, S, V

SEEDS = st.integers(0, 2**32 - 1)
NAMED = {
    name: list(named_property(name, square_track()).unsafe[0]) for name in ("clearance", "hscc20")
}


def convex(random: np.random.Generator) -> Polygon:
    """Return a convex polygon around the origin, its normals of any length."""
    sides = int(random.integers(1, 5))
    angle = random.uniform(0, 2 * math.pi, sides)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    lengths = 10 ** random.uniform(-2, 2, sides)
    centre = random.uniform(-1, 1, 2)
    offsets = normals @ centre + 10 ** random.uniform(-1, 0.5, sides)
    return Polygon(normals * lengths[:, None], offsets * lengths)


def drive(random: np.random.Generator, pose: np.ndarray, period: float, steer: float, slip: bool):
    """Return the path of a row around a pose, and the exact arcs of members of it."""
    width = 10 ** random.uniform(-8, -2)
    slopes = width * random.normal(size=(5, 4)) * 0.4 ** np.arange(5)[:, None]
    errors = random.choice([0.0, 1e-9, 1e-4]) * random.normal(size=(6, 4))
    slopes[:, V], errors[:, V] = 0.0, 0.0
    rows = one_row(pose, slopes, errors, random.choice([0.0, 1e-9]))
    c = np.zeros((TERMS + 6, 1))
    c[0], c[1] = steer, width
    car = Bicycle(slip=slip)
    path = Motion(car, period).drive(rows.state, Models(c, np.zeros(1)))
    members = cars(random, rows, 8)
    states = np.array([m.state for m in members]).T
    steering = steer + width * np.array([m.x for m in members])
    s, f, v, theta = states[S], states[F], states[V], states[THETA]
    arc, _ = car.arc(s, f, v, theta, steering, period)
    return path, arc


def check(path, arc, unsafe, wanted) -> float:
    """Return how far the proved margin is below the exact one of the worst member."""
    proved = least_margin(path, unsafe, wanted)
    exact = float(arc_margin(unsafe, arc).min())
    assert proved[0] <= exact + 1e-12 * max(1.0, abs(exact))
    return exact - float(proved[0])


@settings(max_examples=60)
@given(
    SEEDS, st.sampled_from(sorted(NAMED)), st.booleans(), st.sampled_from([-np.inf, 0.2, np.inf])
)
def test_named_properties(seed, name, slip, wanted):
    random = np.random.default_rng(seed)
    pose = np.array([random.uniform(0.3, 5), random.uniform(0.3, 5), 2.4 * random.random(), 0.0])
    pose[THETA] = random.uniform(-4, 4)
    path, arc = drive(random, pose, 0.1, random.uniform(-0.26, 0.26), slip)
    check(path, arc, NAMED[name], wanted)


@settings(max_examples=60)
@given(SEEDS, st.sampled_from([0.05, 0.5, 3.0, 8.0]), st.sampled_from([-np.inf, 0.2, np.inf]))
@example(1, 3.0, -np.inf)
def test_any_polygons_and_periods(seed, period, wanted):
    """Normals that are not unit vectors, and arcs that bulge by metres from their chords."""
    random = np.random.default_rng(seed)
    pose = np.concatenate([random.uniform(-6, 6, 2), [2.4 * random.random(), 0.0]])
    pose[THETA] = random.uniform(-4, 4)
    steer = random.uniform(-0.3, 0.3) * min(1.0, 0.5 / period)
    with np.errstate(invalid="ignore"):
        path, arc = drive(random, pose, period, steer, bool(random.integers(2)))
    if not np.isfinite(path.state.radius).all():
        return
    check(path, arc, [convex(random) for _ in range(3)], wanted)


def test_a_bulge_of_metres_is_not_forgotten():
    """The chord passes a block by more than 2 m, the arc runs through it."""
    random = np.random.default_rng(0)
    curvature, length = 0.04, 45.0
    period = 45.0 / 2.4
    steer = math.atan(curvature * 0.45)
    # Begun so that the chord runs straight along f.
    pose = np.array([0.0, 0.0, 2.4, -curvature * length / 2])
    path, arc = drive(random, pose, period, steer, False)
    assert arc.distance[0] == pytest.approx(length, rel=1e-2)
    s, f = (float(x[0]) for x in arc.point(arc.distance / 2))
    block = Polygon.from_box((s - 0.1, f - 0.1), (s + 0.1, f + 0.1))
    ends = np.array([[arc.s[0], arc.end[0][0]], [arc.f[0], arc.end[1][0]]])
    assert block.relevant(ends.min(axis=1), ends.max(axis=1), 2.0) is None
    assert arc_margin([block], arc).max() < 0
    assert least_margin(path, [block], -np.inf)[0] <= 0


def test_a_long_normal_stretches_the_bulge():
    """{100 s <= 99}: the arc dips to it between its ends, where the chord does not."""
    random = np.random.default_rng(0)
    steer, period = -0.25, 0.4
    path, arc = drive(random, np.array([1.05, 9.0, 2.4, 0.2]), period, steer, False)
    s = arc.point(np.linspace(0, 1, 101)[:, None] * arc.distance)[0].min()
    ends = min(arc.s.min(), arc.end[0].min())
    assert s < ends - 1e-3
    for length in (1e-2, 1.0, 100.0):
        line = Polygon.from_constraints([[length, 0.0, length * (s + (ends - s) / 2)]])
        assert least_margin(path, [line], np.inf)[0] < 0


def test_the_bound_is_close_for_plain_steps():
    """Within a tenth of a millimetre at the inner corner, where two faces decide."""
    random = np.random.default_rng(0)
    gaps = []
    for _ in range(30):
        pose = np.array([random.uniform(0.8, 1.1), random.uniform(1.2, 1.6), 2.35, -0.5])
        rows = one_row(pose, np.zeros((5, 4)), np.zeros((0, 4)), 0.0)
        c = np.zeros((TERMS, 1))
        c[0] = -0.2
        car = Bicycle()
        path = Motion(car, 0.1).drive(rows.state, Models(c, np.zeros(1)))
        arc, _ = car.arc(*pose[:, None], np.array([-0.2]), 0.1)
        gaps.append(check(path, arc, NAMED["clearance"], np.inf))
    assert max(gaps) < 1e-4


def test_more_pieces_where_the_whole_arc_does_not_suffice():
    random = np.random.default_rng(2)
    path, arc = drive(random, np.array([0.9, 1.4, 2.35, -0.5]), 0.1, -0.25, False)
    coarse = least_margin(path, NAMED["clearance"], -np.inf)[0]
    fine = least_margin(path, NAMED["clearance"], np.inf)[0]
    assert coarse <= fine <= arc_margin(NAMED["clearance"], arc).min()
    assert PIECES == 16


def test_the_check_sees_a_bulge_ten_times_too_small():
    """At the inner corner the arc bulges towards the block; the exact margin tells."""
    bulge = 0.55 * 0.24**2 / 8
    pose = np.array([1.0, 9.0, 2.4, -0.066])
    car, steer = Bicycle(), math.atan(0.55 * 0.45)
    arc, _ = car.arc(*pose[:, None], np.array([steer]), 0.1)
    line = [Polygon.from_constraints([[-1.0, 0.0, -1.2]])]
    exact = float(arc_margin(line, arc)[0])
    at_ends = 1.2 - max(float(arc.s[0]), float(arc.end[0][0]))
    assert at_ends - exact > 0.5 * bulge  # so a bound that forgets a half of it is too high
    rows = one_row(pose, np.zeros((5, 4)), np.zeros((0, 4)), 0.0)
    c = np.zeros((TERMS, 1))
    c[0] = steer
    path = Motion(car, 0.1).drive(rows.state, Models(c, np.zeros(1)))
    proved = least_margin(path, line, -np.inf)[0]
    assert proved <= exact
    assert proved + 0.9 * bulge > exact


def test_unknown_paths_prove_nothing():
    rows = one_row(np.array([0.75, 9.0, 2.0, 0.0]), np.zeros((5, 4)), np.zeros((0, 4)), 0.0)
    c = np.zeros((TERMS, 1))
    with np.errstate(invalid="ignore"):
        path = Motion(Bicycle(), 0.1).drive(rows.state, Models(c, np.array([np.inf])))
        least = least_margin(path, NAMED["clearance"], np.inf)
    assert not (least > 0).any()

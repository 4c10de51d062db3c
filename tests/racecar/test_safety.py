"""Safety: unsafe sets, and the exact margin of an arc against dense sampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from racecar.bicycle import Arc
from racecar.errors import BadInput
from racecar.polygon import Polygon
from racecar.safety import arc_margin, margin, named_property
from racecar.track import square_track, track_from_turns

SAMPLES = 2001


def sampled_margin(unsafe: list[Polygon], arc: Arc) -> np.ndarray:
    """Return the least margin at many points of each arc, one polygon and row at a time."""
    points = arc.point(np.linspace(0, 1, SAMPLES)[:, None] * arc.distance)
    worst = np.full(points[0].shape, np.inf)
    for polygon in unsafe:
        rows = polygon.to_constraints()
        misses = [a * points[0] + b * points[1] - c for a, b, c in rows]
        worst = np.minimum(worst, np.max(misses, axis=0))
    return worst.min(axis=0)


def arcs(random: np.random.Generator, batch: int, spread: float, longest: float) -> Arc:
    s, f = random.uniform(-1, 1, 2)
    sign = random.choice([-1, 1], batch)
    size = 10 ** random.uniform(-13, 1, batch)
    size[random.random(batch) < 0.1] = random.choice([0.0, 5e-324, 1e-300])
    return Arc(
        s + spread * random.uniform(-1, 1, batch),
        f + spread * random.uniform(-1, 1, batch),
        random.uniform(-4, 4) + spread * random.uniform(-3, 3, batch),
        sign * size,
        random.uniform(0, longest, batch) * (random.random(batch) > 0.02),
    )


def polygons(random: np.random.Generator) -> list[Polygon]:
    """Return up to four polygons with up to four sides, normals of any length."""
    made = []
    for _ in range(random.integers(1, 5)):
        sides = random.integers(1, 5)
        angle, length = random.uniform(0, 2 * math.pi, sides), 10 ** random.uniform(-0.5, 0.5)
        normals = length * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        made.append(Polygon(normals, random.uniform(-2, 2, sides)))
    return made


@settings(max_examples=150)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1, 3, 200]),
    st.sampled_from([1e-3, 0.1, 1.0]),
    st.sampled_from([0.24, 1.5]),
    st.sampled_from([None, "anywhere", "just above"]),
)
def test_arc_margin_is_the_limit_of_dense_sampling(seed, batch, spread, longest, below):
    """Sampling never finds less, and finds it up to the distance between two samples.

    Straight arcs, tiny curvatures and more than a full turn (15 rad) are among them.
    """
    random = np.random.default_rng(seed)
    unsafe, arc = polygons(random), arcs(random, batch, spread, longest)
    sampled = sampled_margin(unsafe, arc)
    if below is None:
        exact = arc_margin(unsafe, arc)
    else:
        anywhere = below == "anywhere"
        cap = random.uniform(-1, 2, batch) if anywhere else sampled + random.choice([1e-3, 0.05])
        exact, sampled = arc_margin(unsafe, arc, cap), np.minimum(sampled, cap)
    steepest = max(np.linalg.norm(polygon.normals, axis=1).max() for polygon in unsafe)
    step = arc.distance / (SAMPLES - 1)
    assert (sampled - exact >= -1e-12).all()
    assert (sampled - exact <= steepest * step / 2 + 1e-12).all()


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_on_one_side_of_a_line_sampling_misses_second_order_only(seed):
    """With one constraint the margin is smooth: the error is at most curvature h^2 / 8."""
    random = np.random.default_rng(seed)
    unsafe, arc = [Polygon(np.array([[0.6, -0.8]]), np.array([0.3]))], arcs(random, 100, 1.0, 1.5)
    step = arc.distance / (SAMPLES - 1)
    gap = sampled_margin(unsafe, arc) - arc_margin(unsafe, arc)
    assert (gap >= -1e-12).all()
    assert (gap <= np.abs(arc.curvature) * step**2 / 8 + 1e-12).all()


def one_arc(s: float, f: float, course: float, curvature: float, distance: float) -> Arc:
    return Arc(*(np.array([x]) for x in (s, f, course, curvature, distance)))


def test_least_margin_inside_an_arc():
    """Towards the left wall and away again: a circle of radius 2 m, nearest at its top."""
    wall = [Polygon.from_constraints([[1, 0, 0.3]])]
    angle = 0.06
    arc = one_arc(1.0, 9.0, angle, -0.5, 4 * angle)
    expected = 1.0 - 2.0 * (1 - math.cos(angle)) - 0.3
    assert arc_margin(wall, arc)[0] == pytest.approx(expected, abs=1e-15)
    assert min(margin(wall, arc.s, arc.f)[0], margin(wall, *arc.end)[0]) > expected + 1e-4


def test_least_margin_where_the_largest_miss_changes():
    """Straight past the inner corner: from beside one face to beside the other.

    Misses 1.2 - s falls and 1.2 - f rises; the least of the greater is where s = f.
    """
    block = [Polygon.from_box((1.2, 1.2), (math.inf, math.inf))]
    # s = 0.9 + t / sqrt 2, f = 1.05 - t / sqrt 2: they meet at 0.975, margin 0.225.
    arc = one_arc(0.9, 1.05, -math.pi / 4, 0.0, 0.24)
    assert arc_margin(block, arc)[0] == pytest.approx(0.225, abs=1e-15)
    for curvature in (0.5, -0.5, 1e-12, -1e-12, 1e-300):
        bent = one_arc(0.9, 1.05, -math.pi / 4, curvature, 0.24)
        t = np.linspace(0, 0.24, 200_001)
        s, f = Arc(bent.s, bent.f, bent.course, bent.curvature, t).end
        fine = np.maximum(1.2 - s, 1.2 - f).min()
        assert arc_margin(block, bent)[0] == pytest.approx(fine, abs=1e-6)
        assert arc_margin(block, bent)[0] <= fine + 1e-15


def test_a_constraint_that_matters_only_in_the_middle_of_an_arc():
    """One miss dips by the sagitta, the other, less at both ends, rises above it and saves it."""
    angle, radius = 0.07, 2.0
    arc = one_arc(1.0, 9.0, angle, -1 / radius, 2 * angle * radius)
    sagitta = radius * (1 - math.cos(angle))
    # At the ends 0.5 and 0.5 - 1.2 sagitta; they meet 0.6 sagitta further.
    wedge = [Polygon.from_constraints([[1, 0, 0.5], [-1, 0, -1.5 + 1.2 * sagitta]])]
    assert arc_margin(wedge, arc)[0] == pytest.approx(0.5 - 0.6 * sagitta, abs=1e-13)


@pytest.mark.parametrize("curvature", [0.6, -0.6, 0.01, -3.0])
@pytest.mark.parametrize("slant", [1.0, 2.5])
def test_the_least_margin_is_found_wherever_it_lies_on_the_arc(curvature, slant):
    """Lowest after every share of the arc; also where the answer just undercuts ``below``."""
    wall = [Polygon.from_constraints([[slant, 0, 0.0]])]
    for share in np.linspace(0.002, 0.998, 250):
        # s is least where the course is along the hall; then the car turns away (curvature
        # negative: to the right) or, the other way round, s is greatest there.
        course = -curvature * 0.24 * share + (math.pi if curvature > 0 else 0.0)
        arc = one_arc(1.0, 9.0, course, curvature, 0.24)
        radius, turned = 1 / abs(curvature), abs(curvature) * 0.24 * share
        lowest = slant * (1.0 - 2 * radius * math.sin(turned / 2) ** 2)
        assert arc_margin(wall, arc)[0] == pytest.approx(lowest, abs=1e-14)
        for excess in (1e-7, 1e-4):
            below = np.array([lowest + excess])
            assert arc_margin(wall, arc, below)[0] == pytest.approx(lowest, abs=1e-14)


@pytest.mark.parametrize(
    ("course", "curvature", "lowest"),
    [
        # s = 1 + (cos(course + curvature d) - cos(course)) / curvature, at its least
        (-math.pi / 2, 4.0, 0.75),  # three quarters round, where arctan alone would not look
        (-math.pi / 2, -4.0, 0.75),
        (-0.3, 4.0, 1 - (1 + math.cos(0.3)) / 4),
        (0.3, -4.0, 1 - (1 - math.cos(0.3)) / 4),
    ],
)
def test_hairpins_beyond_half_a_turn(course, curvature, lowest):
    wall = [Polygon.from_constraints([[1, 0, 0.0]])]
    arc = one_arc(1.0, 5.0, course, curvature, 1.5)  # 6 rad in all
    assert arc_margin(wall, arc)[0] == pytest.approx(lowest, abs=1e-14)


@given(st.floats(0.01, 1.49), st.floats(0.01, 14.0))
def test_clearance_in_the_hall_and_the_corner_square(s, f):
    """DESIGN.md, section 1: clearance = min(s, f, max(W - s, W - f))."""
    unsafe = named_property("clearance", square_track()).unsafe[0]
    expected = min(s, f, max(1.5 - s, 1.5 - f)) - 0.3
    assert margin(unsafe, np.array([s]), np.array([f]))[0] == pytest.approx(expected, abs=1e-14)


@given(st.floats(1.5, 14.0), st.floats(0.01, 1.49))
def test_clearance_after_the_corner(s, f):
    unsafe = named_property("clearance", square_track()).unsafe[0]
    expected = min(s, f, 1.5 - f) - 0.3
    assert margin(unsafe, np.array([s]), np.array([f]))[0] == pytest.approx(expected, abs=1e-14)


def test_margin_of_few_and_of_many_points_is_the_same():
    unsafe = named_property("clearance", square_track()).unsafe[0]
    random = np.random.default_rng(0)
    for spread in (0.01, 1, 20):
        s, f = 1 + spread * random.uniform(-1, 1, (2, 500))
        many = margin(unsafe, s, f)
        few = np.array([margin(unsafe, s[i : i + 1], f[i : i + 1])[0] for i in range(500)])
        assert np.abs(many - few).max() < 1e-14
        assert margin(unsafe, s.reshape(5, 100), f.reshape(5, 100)).shape == (5, 100)


@given(st.floats(0.0, 14.0), st.floats(0.0, 14.0))
def test_hscc20_is_the_papers_set(s, f):
    """The walls by 0.3 m; at the inner block 0.3 m from a face only beside that face."""
    unsafe = named_property("hscc20", square_track()).unsafe[0]
    is_unsafe = (
        s <= 0.3 or f <= 0.3 or (s >= 1.2 and f >= 1.5) or (s >= 1.5 and f >= 1.2)
    )  # fmt: skip
    assert (margin(unsafe, np.array([s]), np.array([f]))[0] <= 0) == is_unsafe


def test_the_properties_differ_only_near_the_inner_corner():
    random = np.random.default_rng(0)
    s, f = random.uniform(0, 14, (2, 20_000))
    s[:5000], f[:5000] = random.uniform(1.1, 1.6, (2, 5000))
    strong, weak = (
        margin(named_property(name, square_track()).unsafe[0], s, f) <= 0
        for name in ("clearance", "hscc20")
    )
    assert not np.any(weak & ~strong)
    differ = strong & ~weak
    assert differ.any()
    assert (s[differ] >= 1.2).all()
    assert (s[differ] < 1.5).all()
    assert (f[differ] >= 1.2).all()
    assert (f[differ] < 1.5).all()


def test_clearance_on_any_track_is_the_distance_to_the_walls():
    track = track_from_turns(["left", "right", "right"], length=9.0)
    safety = named_property("clearance", track)
    random = np.random.default_rng(0)
    s, f = random.uniform(0, 1.5, 300), random.uniform(0, 9, 300)
    for index, frame in enumerate(track.frames):
        to_walls = np.min([wall.separation(s, f) for wall in frame.obstacles], axis=0)
        assert margin(safety.unsafe[index], s, f) == pytest.approx(to_walls - 0.3, abs=1e-12)


def test_offsets_of_the_unsafe_sets_are_short_decimals():
    rows = [
        row
        for polygons in named_property("clearance", square_track()).unsafe
        for polygon in polygons
        for row in polygon.to_constraints()
    ]
    assert [-1.0, 0.0, -1.2] in rows
    assert all(b == round(b, 1) for _, _, b in rows)


def test_an_unknown_property_is_refused():
    with pytest.raises(BadInput, match="'safe' is unknown; choose one of clearance, hscc20"):
        named_property("safe", square_track())


def test_nan_is_never_safe():
    unsafe = named_property("clearance", square_track()).unsafe[0]
    nan, one = np.array([math.nan] * 100 + [0.7]), np.array([5.0] * 101)
    assert np.isnan(margin(unsafe, nan, one)[:100]).all()
    assert margin(unsafe, nan, one)[100] == pytest.approx(0.4)
    arc = Arc(nan, one, 0 * one, 0 * one, 0.1 * one)
    assert np.isnan(arc_margin(unsafe, arc)[:100]).all()
    assert arc_margin(unsafe, arc)[100] == pytest.approx(0.4)

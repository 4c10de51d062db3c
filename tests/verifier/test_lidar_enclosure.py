"""What cars measure lies in the enclosure of their row, at jumps, kinks and between."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from enclosed import (
    EVALUATION,
    TRACKS,
    belongs,
    cars,
    one_row,
    places_in,
    problem_of,
    settle,
    value_at,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st
from retraced import RetracingMonkeyPatch

from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.track import Track
from verifier import scan as under_test
from verifier.models import Models
from verifier.proof import Prover
from verifier.rows import THETA, F, S, V
from verifier.scan import Scanner

SEEDS = st.integers(0, 2**32 - 1)
LIDARS = {
    "21 rays": Lidar(21),
    "all around": Lidar(12, 2 * math.pi),
    "61 rays": Lidar(61, math.radians(270)),
    "short": Lidar(9, math.pi, 0.6),
    "far": Lidar(15, math.pi, 30.0),
}


def corners(track: Track, frame: int) -> np.ndarray:
    """Return the corners of all boxes of a frame that are not at infinity, ``[n, 2]``."""
    found = []
    for wall in track.frames[frame].obstacles:
        s = [b * n[0] for n, b in zip(wall.normals, wall.offsets, strict=True) if n[0]]
        f = [b * n[1] for n, b in zip(wall.normals, wall.offsets, strict=True) if n[1]]
        found += [(x, y) for x in s for y in f]
    return np.array(found or [(0.0, 0.0)])


def free_pose(random: np.random.Generator, track: Track, lidar: Lidar) -> tuple[int, np.ndarray]:
    """Return a frame and a pose in its corner region, in half of all cases with a ray that
    points just beside a corner of a wall."""
    frame = int(random.integers(len(track.frames)))
    obstacles = track.frames[frame].obstacles
    while True:
        s, f = random.uniform(0, min(5, track.width * 2), 2)
        f += random.choice([0, 2])
        if min(wall.separation(s, f) for wall in obstacles) > 0.03:
            break
    theta = random.uniform(-math.pi, math.pi)
    if random.random() < 0.5:
        near = corners(track, frame)
        near = near[np.argsort(np.hypot(near[:, 0] - s, near[:, 1] - f))[:3]]
        corner = near[random.integers(len(near))]
        course = math.atan2(s - corner[0], f - corner[1])
        theta = (
            course - random.choice(lidar.angles) + random.normal() * 10 ** random.uniform(-9, -1)
        )
    return frame, np.array([s, f, 1.0, theta])


def random_row(random: np.random.Generator, track: Track, lidar: Lidar):
    frame, pose = free_pose(random, track, lidar)
    width = 10 ** random.uniform(-7, -1.5)
    slopes = width * random.normal(size=(5, 4)) * 0.4 ** np.arange(5)[:, None]
    errors = random.choice([0.0, 1e-9, 1e-5]) * random.normal(size=(6, 4))
    slopes[:, V], errors[:, V] = 0.0, 0.0
    rows = one_row(pose, slopes, errors, random.choice([0.0, 1e-12, 1e-6]))
    rows.frame[0] = frame
    return rows


def follow(track: Track, lidar: Lidar, seed: int, kink: float, count: int = 12):
    """Settle a random row and look for the scans of its members.

    Returns the share of members found and the largest deviation over the claimed radius.
    """
    random = np.random.default_rng(seed)
    rows = random_row(random, track, lidar)
    prover = Prover(problem_of(track, lidar), 0.0)
    settled, scans, failed = settle(prover, rows, kink)
    obstacles = track.frames[int(rows.frame[0])].obstacles
    found, worst = 0, 0.0
    for car in cars(random, rows, count):
        measured = lidar.scan(obstacles, car.state[S], car.state[F], car.state[THETA])[0]
        held, doubtful = False, False
        for part, scan in zip(settled, scans, strict=True):
            for row, x in enumerate(places_in(part, car.x)):
                if abs(x) > 1 + 1e-9:
                    continue
                fits = belongs(part, row, prover, car)
                doubtful |= fits is None
                if not fits:
                    continue
                off = np.abs(measured - value_at(scan, row, float(np.clip(x, -1, 1)), car.e))
                radius = scan.radius[:, row]
                assert (off <= radius + EVALUATION * lidar.range**2).all(), (car, off - radius)
                held = True
                worst = max(worst, float(np.max((off - EVALUATION) / np.maximum(radius, 1e-300))))
        given_up = (np.abs(places_in(failed, car.x)) <= 1 + 1e-9).any() if len(failed) else False
        assert held or given_up or doubtful, car
        found += held
    return found / count, worst


@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
@pytest.mark.parametrize("track", TRACKS.values(), ids=TRACKS)
@settings(max_examples=8)
@given(SEEDS, st.sampled_from([1e-9, 1e-7, 1e-4, 1e-2]))
def test_scans_of_members_lie_in_the_enclosure(track, lidar, seed, kink):
    follow(track, lidar, seed, kink)


def test_most_members_are_found_and_fill_the_enclosure():
    """Else the test above would be empty, or miss bounds that are ten times too small."""
    shares, worst = [], []
    for seed in range(40):
        share, filled = follow(TRACKS["square"], LIDARS["21 rays"], seed, 1e-7, 4)
        shares.append(share)
        worst.append(filled)
    assert np.mean(shares) > 0.9
    assert 0.2 < max(worst) <= 1 + 1e-6


def corner_row(theta: float, spread: float) -> object:
    """A car before the turn, one of whose rays passes the inner corner."""
    course = math.atan2(0.7 - 1.5, 2.5 - 1.5)
    slopes = np.zeros((5, 4))
    slopes[0] = [0.0, 0.0, 0.0, spread]
    return one_row(np.array([0.7, 2.5, 1.0, course + theta]), slopes, np.zeros((0, 4)), 0.0)


@pytest.mark.parametrize("spread", [1e-6, 1e-3, 0.05])
def test_a_jump_is_cut_where_it_is(spread):
    """One ray turns past the inner corner: a part of the row sees the block, the other beyond."""
    lidar = Lidar(3, 0.2)
    rows = corner_row(0.3 * spread, spread)
    prover = Prover(problem_of(TRACKS["square"], lidar), 0.0)
    settled, scans, failed = settle(prover, rows, 1e-7)
    assert not len(failed)
    edges = sorted(
        (float(part.low[i]), float(part.high[i]), float(scan.c[0, 1, i]))
        for part, scan in zip(settled, scans, strict=True)
        for i in range(len(part))
    )
    assert -1.0 - 1e-11 < edges[0][0] <= -1.0
    assert 1.0 <= edges[-1][1] < 1.0 + 1e-11
    assert all(a[1] >= b[0] for a, b in itertools.pairwise(edges))
    near = [e for e in edges if e[2] < 2.0]
    far = [e for e in edges if e[2] > 2.0]
    assert near
    assert far
    jump = max(e[1] for e in near) if near[0][0] <= -1.0 else min(e[0] for e in near)
    assert jump == pytest.approx(-0.3, abs=1e-3)


#: A sliver between two halls, seen from beside its end, and a wall far behind it.
SLIVER = [
    Polygon.from_constraints([[-1, 0, -1.0], [1, 0, 3.0], [0, 1, 1.0], [0, -1, -(1.0 - 1e-6)]]),
    Polygon.from_constraints([[0, 1, -3.0]]),
]


def test_a_kink_does_not_hide_a_jump():
    """Rays pass the end of the sliver and its top at nearly the same distance.

    Which comes first is a kink, and a slack in the measurement covers it. But a ray that passes
    the end later than the bottom misses the sliver: it may not be taken for a kink.
    """
    lidar, random = Lidar(2, 1e-9), np.random.default_rng(0)
    scanner = Scanner(lidar, SLIVER)
    settled = missed = 0
    for _ in range(200):
        s, above, kink = 0.5, random.uniform(0.025, 0.05), 10 ** random.uniform(-5, -1)
        spread = 10 ** random.uniform(-7, -3)
        f = 1.0 + above + spread * random.uniform(-1, 1)
        slopes = np.zeros((5, 4))
        slopes[0, F] = spread
        theta = math.atan2(-0.5, above)  # towards the tip at (1, 1), seen from (s, 1 + above)
        rows = one_row(np.array([s, f, 1.0, theta]), slopes, np.zeros((0, 4)), 0.0)
        scan = scanner.measure(rows, kink)
        x = np.linspace(-1, 1, 41)
        measured = lidar.scan(SLIVER, np.full(41, s), f + spread * x, np.full(41, theta))
        hits = (measured < 1.0).all(axis=1)
        if scan.unclear[0] or len(scan.guards.row):
            missed += not hits.all()
            continue
        settled += 1
        for i in range(41):
            off = np.abs(measured[i] - value_at(scan.distance, 0, x[i], np.zeros(0)))
            assert (off <= scan.distance.radius[:, 0] + 1e-9).all()
    assert settled > 20
    assert missed > 20


def test_no_wall_within_range():
    """A scanner that sees half a metre, in the middle of a hall."""
    lidar = Lidar(5, math.pi, 0.5)
    rows = one_row(np.array([0.75, 9.0, 1.0, 0.0]), np.zeros((5, 4)), np.zeros((0, 4)), 0.0)
    scan = Scanner(lidar, TRACKS["square"].frames[0].obstacles).measure(rows, 1e-7)
    assert not scan.unclear.any()
    assert not len(scan.guards.row)
    assert (scan.distance.c[0] == 0.5).all()
    assert (scan.distance.radius < 1e-100).all()


@pytest.mark.parametrize("s", [-0.1, -0.001, -7.0, 1e-6, 5e-5])
def test_a_car_inside_a_wall_or_upon_it_is_not_measured(s):
    """Simulated, it reads 0; deep inside, no face of the wall is within range."""
    lidar = Lidar(5, math.radians(230))
    rows = one_row(np.array([s, 9.0, 1.0, 0.0]), np.zeros((5, 4)), np.zeros((0, 4)), 0.0)
    scan = Scanner(lidar, TRACKS["square"].frames[0].obstacles).measure(rows, 1e-7)
    assert scan.unclear.any() or len(scan.guards.row)


@pytest.mark.parametrize("theta", [1e4, np.nan, np.inf])
def test_an_unknown_heading_is_not_measured(theta):
    rows = one_row(np.array([0.75, 9.0, 1.0, theta]), np.zeros((5, 4)), np.zeros((0, 4)), 0.0)
    scanner = Scanner(Lidar(5, 0.1), TRACKS["square"].frames[0].obstacles)
    with np.errstate(invalid="ignore"):
        scan = scanner.measure(rows, 1e-7)
    settled = not (scan.unclear.any() or len(scan.guards.row))
    assert not settled


@given(SEEDS)
@example(0)
@settings(max_examples=5)
def test_the_check_sees_directions_without_their_error(seed):
    """Cosine and sine of a ray are rounded: a row of one point shows it."""
    random = np.random.default_rng(seed)
    lidar = Lidar(21)
    pose = np.array([0.4 + 0.5 * random.random(), 9.0, 1.0, 0.1 * random.random()])
    rows = one_row(pose, np.zeros((5, 4)), np.zeros((0, 4)), 0.0)
    scan = Scanner(lidar, TRACKS["square"].frames[0].obstacles).measure(rows, 1e-7)
    assert not len(scan.guards.row)
    assert exact_hits(pose, lidar, scan.distance) <= 1
    with RetracingMonkeyPatch.context() as patch:
        patch.setattr(under_test, "SIN_COS_ERROR", 0.0)
        patch.setattr("verifier.functions.ROUNDING", 0.0)
        patch.setattr(under_test, "U", 0.0)
        patch.setattr("verifier.arithmetic.U", 0.0)
        patch.setattr("verifier.arithmetic.gamma", lambda n: 0.0)
        scan = Scanner(lidar, TRACKS["square"].frames[0].obstacles).measure(rows, 1e-7)
        assert exact_hits(pose, lidar, scan.distance) > 1


def exact_hits(pose: np.ndarray, lidar: Lidar, distance: Models) -> float:
    """Return the worst excess over rays that hit the left wall, their angles taken as real."""
    from exact_members import Place, arb, excess

    worst = 0.0
    for i in range(lidar.rays):
        angle = arb(lidar.field_of_view) * (arb(i) / (lidar.rays - 1) - arb(1) / 2)
        sine = (arb(float(pose[THETA])) + angle).sin()
        if not sine > arb(float(pose[S])) / arb(lidar.range):
            continue
        exact = arb(float(pose[S])) / sine
        worst = max(worst, excess(distance, (i, 0), Place(0.0, np.zeros(0)), exact))
    return worst

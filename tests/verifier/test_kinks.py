"""Rays that may end at either of two faces, or at the range, on rows of centimetres."""

from __future__ import annotations

import math

import numpy as np
import pytest
from enclosed import EVALUATION, TRACKS, cars, one_row, value_at
from hypothesis import given, settings
from hypothesis import strategies as st

from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.track import Track
from verifier import kinks as under_test
from verifier.kinks import Kinks, bends
from verifier.rows import THETA, F, S, V
from verifier.scan import Scanner

SEEDS = st.integers(0, 2**32 - 1)
#: All kinks are kept.
EVERY = 1e9
ROOM = [
    Polygon.from_constraints([[1, 0, 0.0]]),
    Polygon.from_constraints([[0, 1, 0.0]]),
]
#: A pillar, and a wall some way behind it.
PILLAR = [
    Polygon.from_constraints([[-1, 0, -1.0], [1, 0, 1.4], [0, 1, 1.5], [0, -1, -1.0]]),
    Polygon.from_constraints([[0, 1, 0.9]]),
]


def wide_row(random: np.random.Generator, pose: np.ndarray, size: float):
    slopes = size * random.normal(size=(5, 4)) * 0.3 ** np.arange(5)[:, None]
    errors = size * random.normal(size=(6, 4)) * np.array([1.0, 0.1] * 3)[:, None]
    slopes[:, V], errors[:, V] = 0.0, 0.0
    return one_row(pose, slopes, errors, random.choice([0.0, 0.1 * size]))


def excess(obstacles: list[Polygon], lidar: Lidar, rows, random, count: int) -> float | None:
    """Return the largest deviation over the radius among members; None: not settled."""
    with np.errstate(all="ignore"):
        scan = Scanner(lidar, obstacles).measure(rows, EVERY)
    if scan.unclear.any() or len(scan.guards.row):
        return None
    worst = 0.0
    for car in cars(random, rows, count):
        measured = lidar.scan(obstacles, car.state[S], car.state[F], car.state[THETA])[0]
        off = np.abs(measured - value_at(scan.distance, 0, car.x, car.e))
        worst = max(worst, float(((off - EVALUATION) / (scan.distance.radius[:, 0] + 1e-12)).max()))
    return worst


@pytest.mark.parametrize("name", ["square", "left", "uneven", "thin block"])
@settings(max_examples=60)
@given(SEEDS, st.sampled_from([1e-4, 1e-3, 1e-2, 3e-2]))
def test_members_of_wide_rows_are_held_at_kinks(name, seed, size):
    random, track = np.random.default_rng(seed), TRACKS[name]
    look(random, track, size)


def look(random: np.random.Generator, track: Track, size: float) -> float | None:
    pose = np.array([random.uniform(0.2, 1.3), random.uniform(0.2, 7.0), 1.0, random.normal()])
    found = excess(track.frames[0].obstacles, Lidar(21), wide_row(random, pose, size), random, 40)
    assert found is None or found <= 1
    return found


def test_many_rows_are_settled():
    random = np.random.default_rng(0)
    found = [look(random, TRACKS["square"], 1e-2) for _ in range(200)]
    assert sum(f is not None for f in found) > 60


def corner_rows(random: np.random.Generator):
    """Give rows one of whose two rays points about into the corner of two walls."""
    for _ in range(60):
        s, f = random.uniform(0.5, 2.0, 2)
        yield np.array([s, f, 1.0, math.atan2(s, f) + 0.01 * random.normal()])


def pillar_rows(random: np.random.Generator):
    """Give rows one of whose rays points about at the near corner of the pillar."""
    for _ in range(60):
        s, f = random.uniform(0.2, 0.8), random.uniform(1.7, 2.5)
        yield np.array([s, f, 1.0, math.atan2(s - 1.0, f - 1.5) + 0.01 * random.normal()])


def range_rows(random: np.random.Generator):
    """Give rows one of whose rays just reaches a wall."""
    for _ in range(60):
        yield np.array([3.0, 1.0 + 0.02 * random.normal(), 1.0, 0.3 * random.normal()])


PLACES = {
    "outer corner": (corner_rows, ROOM, Lidar(2, 1e-6)),
    "pillar": (pillar_rows, PILLAR, Lidar(2, 1e-6)),
    "range": (range_rows, ROOM[1:], Lidar(2, 1e-6, 1.0)),
}


def worst_at(name: str) -> float:
    """Return the largest share of the radius that members use, at kinks of one kind."""
    draw, obstacles, lidar = PLACES[name]
    random = np.random.default_rng(1)
    found = []
    for pose in draw(random):
        size = 10 ** random.uniform(-3, -1.7)
        found.append(excess(obstacles, lidar, wide_row(random, pose, size), random, 60))
    settled = [f for f in found if f is not None]
    assert len(settled) > 40
    return max(settled)


@pytest.mark.parametrize("name", PLACES)
def test_chords_hold_and_are_needed(monkeypatch, name):
    assert 0.5 < worst_at(name) <= 1
    monkeypatch.setattr(Kinks, "gap", property(lambda self: 0.5 * _gap(self)))
    assert worst_at(name) > 1


_gap = Kinks.gap.fget


@pytest.mark.parametrize("name", ["outer corner", "range"])
def test_the_check_sees_a_wrong_slope(monkeypatch, name):
    """Half of the slope, with the gap of the whole one."""
    share = Kinks.share.fget
    monkeypatch.setattr(under_test.Kinks, "gap", property(_gap_of(share)))
    monkeypatch.setattr(under_test.Kinks, "share", property(lambda self: 0.5 * share(self)))
    assert worst_at(name) > 1


def _gap_of(share):
    def gap(self):
        s = share(self)
        return np.maximum(self.fails * (1 - s), s * np.maximum(self.most, 0.0))

    return gap


@settings(max_examples=300)
@given(SEEDS)
def test_bends_hold_all_that_the_kinks_of_a_ray_allow(seed):
    """Real rays: a wall met at the least of some u, others at any place up to their own u."""
    random = np.random.default_rng(seed)
    members, inner, outer = 30, int(random.integers(0, 3)), int(random.integers(0, 3))
    u = random.normal(size=members)
    inside = u + random.normal(0.3, 0.5, (inner, 1)) + 0.5 * random.normal(size=(inner, members))
    beyond = u - random.normal(0.3, 0.5, (outer, 1)) + 0.5 * random.normal(size=(outer, members))
    sure_outer = random.random(outer) < 0.5
    at = np.where(
        sure_outer[:, None], beyond, np.where(random.random(beyond.shape) < 0.5, beyond, -9.0)
    )
    true = np.minimum(u, inside.min(axis=0, initial=np.inf))
    true = np.maximum(true, at.max(axis=0, initial=-np.inf))
    g = np.concatenate([inside - u, u - beyond])
    if not len(g) or not (g.min(axis=1) < 0).any():
        return
    fails = g.min(axis=1) < 0
    kinks = Kinks(
        np.zeros(len(g), dtype=np.intp)[fails],
        np.arange(len(g))[fails],
        (np.arange(len(g)) < inner)[fails],
        g.min(axis=1)[fails],
        g.max(axis=1)[fails],
        np.concatenate([np.ones(inner, dtype=bool), sure_outer])[fails],
    )
    least = g[inner:].min(initial=np.inf)
    bent = bends(kinks, np.array([least]))
    other = np.concatenate([inside, beyond])[bent.other[0]]
    line = (1 - bent.share[0]) * u + bent.share[0] * other + bent.middle[0]
    assert (np.abs(true - line) <= bent.slack[0] * (1 + 1e-9) + 1e-12).all()

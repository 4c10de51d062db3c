"""The track: local frames and the plane describe the same halls."""

from __future__ import annotations

import math

import numpy as np
import pytest
from global_geometry import TRACKS, lay_out
from hypothesis import given, settings
from hypothesis import strategies as st

from racecar.errors import BadInput
from racecar.track import Hall, Track, square_track, track_from_turns


def inside_halls(track: Track, x: np.ndarray, y: np.ndarray, slack: float) -> np.ndarray:
    rectangles = [place.rectangle() for place in lay_out(track)]
    return np.any(
        [
            (x0 - slack < x) & (x < x1 + slack) & (y0 - slack < y) & (y < y1 + slack)
            for x0, x1, y0, y1 in rectangles
        ],
        axis=0,
    )


@settings(max_examples=50)
@given(TRACKS, st.integers(0, 2**32 - 1))
def test_walls_cover_all_but_the_halls(track, seed):
    random = np.random.default_rng(seed)
    extent = max(abs(v) for place in lay_out(track) for v in place.rectangle()) + 2
    x, y = random.uniform(-extent, extent, (2, 400))
    walls = np.any([wall.separation(x, y) <= 0 for wall in track.walls], axis=0)
    assert not np.any(walls & inside_halls(track, x, y, -1e-9))
    assert not np.any(~walls & ~inside_halls(track, x, y, 1e-9))


@settings(max_examples=50)
@given(TRACKS, st.integers(0, 2**32 - 1))
def test_local_obstacles_are_the_global_walls(track, seed):
    random = np.random.default_rng(seed)
    for index, frame in enumerate(track.frames):
        s, f = random.uniform(-5, 10, 200), random.uniform(-5, 25, 200)
        x, y, _ = track.to_global(index, s, f, 0.0)
        local = np.min([wall.separation(s, f) for wall in frame.obstacles], axis=0)
        on_plane = np.min([wall.separation(x, y) for wall in track.walls], axis=0)
        # Both are the distance to the nearest wall in the maximum norm.
        assert np.abs(local - on_plane).max() < 1e-12 * 100


@settings(max_examples=50)
@given(TRACKS, st.floats(-5, 25), st.floats(-5, 25), st.floats(-4, 4))
def test_to_global_agrees_with_a_walk_along_the_halls(track, s, f, theta):
    for index, place in enumerate(lay_out(track)):
        x, y, heading = track.to_global(index, s, f, theta)
        assert (x, y) == pytest.approx(place.point(s, f), abs=1e-12)
        turned = heading - theta - place.angle
        assert math.remainder(turned, 2 * math.pi) == pytest.approx(0, abs=1e-12)


@settings(max_examples=50)
@given(TRACKS, st.floats(-5, 25), st.floats(-5, 25), st.floats(-4, 4))
def test_an_advance_keeps_the_place_on_the_plane(track, s, f, theta):
    for index, frame in enumerate(track.frames):
        if frame.advance is None:
            assert index == len(track.halls) - 1
            assert not track.closed
            continue
        change = frame.advance
        s2, f2 = np.array(change.matrix) @ [s, f] + change.offset
        before = np.array(track.to_global(index, s, f, theta))
        after = np.array(track.to_global(change.to, s2, f2, theta + change.rotation))
        assert np.abs(before[:2] - after[:2]).max() < 1e-11
        assert math.remainder(before[2] - after[2], 2 * math.pi) == pytest.approx(0, abs=1e-12)


def test_the_square_is_the_papers():
    track = square_track()
    frame = track.frames[0]
    assert len(track.frames) == 4
    assert list(track.alike) == [0, 0, 0, 0]
    # (s, f, theta) <- (f, 20 - s, theta + pi/2) when s > 5: DESIGN.md, section 1.
    assert frame.advance is not None
    assert frame.advance.guard == (1.0, 0.0, 5.0)
    s, f = np.array(frame.advance.matrix) @ [6.0, 0.7] + frame.advance.offset
    assert (s, f) == (0.7, 14.0)
    assert frame.advance.rotation == math.pi / 2
    # The inner corner block of the turn is {s > W and f > W}, as far as the next corners.
    block = [p for p in frame.obstacles if p.separation(2.0, 2.0) < 0]
    assert len(block) == 1
    assert block[0].separation(1.5, 1.5) == 0
    assert block[0].separation(1.4, 19.0) == pytest.approx(0.5)


def test_a_mirrored_track_has_mirrored_frames():
    right, left = track_from_turns(["right", "right"]), track_from_turns(["left", "left"])
    random = np.random.default_rng(0)
    s, f = random.uniform(-3, 8, 500), random.uniform(-3, 22, 500)
    for a, b in zip(right.frames, left.frames, strict=True):
        there = np.min([wall.separation(s, f) for wall in a.obstacles], axis=0)
        here = np.min([wall.separation(1.5 - s, f) for wall in b.obstacles], axis=0)
        assert np.abs(there - here).max() < 1e-12


def test_an_open_track_ends_in_a_wall():
    track = track_from_turns(["left"], length=8.0)
    last = track.frames[-1]
    assert last.advance is None
    assert min(wall.separation(0.75, -0.01) for wall in last.obstacles) < 0
    assert min(wall.separation(0.75, 0.01) for wall in last.obstacles) > 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Track(1.5, ()), "no halls"),
        (lambda: Track(0.0, (Hall(20, None),), False), "width is 0"),
        (lambda: Track(math.nan, (Hall(20, None),), False), "width is nan"),
        (lambda: Track(1.5, (Hall(20, "up"), Hall(20, None)), False), "hall 0 has turn 'up'"),
        (lambda: Track(1.5, (Hall(20, None),)), "hall 0 has turn None"),
        (lambda: Track(1.5, (Hall(20, "left"),), False), "hall 0 has turn 'left'"),
        (lambda: Track(1.5, (Hall(2.9, None),), False), "at least two widths"),
        (lambda: Track(1.5, (Hall(math.inf, None),), False), "at least two widths"),
        (lambda: track_from_turns(["right"] * 3, closed=True), "does not lead back"),
        (lambda: track_from_turns(["right", "left"] * 2, closed=True), "does not lead back"),
        (lambda: track_from_turns(["right"] * 5), "meet"),
        (lambda: Track(1.5, (*[Hall(9.0, "right")] * 2, Hall(3.0, None)), False), None),
        (lambda: Track(1.5, (Hall(9, "left"), Hall(3, "left"), Hall(9, None)), False), "meet"),
    ],
)  # fmt: skip
def test_only_sound_tracks_are_accepted(make, message):
    if message is None:
        make()
        return
    with pytest.raises(BadInput, match=message) as caught:
        make()
    assert str(caught.value).startswith("track: ")

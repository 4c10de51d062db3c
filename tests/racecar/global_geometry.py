"""A second geometry for tests: halls as rectangles on the plane, rays against segments.

It shares nothing with racecar's track, cover and LiDAR but the description of the halls.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from racecar.errors import BadInput
from racecar.track import Hall, Track


@dataclass(frozen=True)
class Place:
    """A hall on the plane: its left front corner and its direction of travel (unit vector)."""

    corner: tuple[float, float]
    ahead: tuple[int, int]
    width: float
    length: float

    @property
    def left(self) -> tuple[int, int]:
        return -self.ahead[1], self.ahead[0]

    def point(self, s: float, f: float) -> tuple[float, float]:
        (x, y), (ax, ay), (lx, ly) = self.corner, self.ahead, self.left
        return x - s * lx - f * ax, y - s * ly - f * ay

    def rectangle(self) -> tuple[float, float, float, float]:
        (xa, ya), (xb, yb) = self.corner, self.point(self.width, self.length)
        return min(xa, xb), max(xa, xb), min(ya, yb), max(ya, yb)

    @property
    def angle(self) -> float:
        return math.atan2(self.ahead[1], self.ahead[0])


def lay_out(track: Track) -> list[Place]:
    """Walk the halls: each begins at the outer corner of the turn before it."""
    width = track.width
    places = [Place((0.0, 0.0), (1, 0), width, track.halls[0].length)]
    for turn, hall in zip(track.halls[:-1], track.halls[1:], strict=True):
        old = places[-1]
        (ax, ay), (lx, ly) = old.ahead, old.left
        if turn.turn == "right":
            outer, ahead = old.corner, (-lx, -ly)
            corner = outer[0] + hall.length * ahead[0], outer[1] + hall.length * ahead[1]
        else:
            outer, ahead = old.point(width, 0.0), (lx, ly)
            right = outer[0] + hall.length * ahead[0], outer[1] + hall.length * ahead[1]
            corner = right[0] - width * ax, right[1] - width * ay
        places.append(Place(corner, ahead, width, hall.length))
    return places


def outline(places: list[Place]) -> np.ndarray:
    """Return the walls as segments ``[walls, 2, 2]``: sides of halls that border no other."""
    rectangles = [place.rectangle() for place in places]
    xs = sorted({x for r in rectangles for x in r[:2]})
    ys = sorted({y for r in rectangles for y in r[2:]})

    def free(x: float, y: float) -> bool:
        return any(x0 < x < x1 and y0 < y < y1 for x0, x1, y0, y1 in rectangles)

    segments = []
    for x0, x1, y0, y1 in rectangles:
        for x, out in ((x0, -1e-6), (x1, 1e-6)):
            cuts = [y for y in ys if y0 <= y <= y1]
            for a, b in itertools.pairwise(cuts):
                if b - a > 1e-9 and not free(x + out, (a + b) / 2):
                    segments.append([[x, a], [x, b]])
        for y, out in ((y0, -1e-6), (y1, 1e-6)):
            cuts = [x for x in xs if x0 <= x <= x1]
            for a, b in itertools.pairwise(cuts):
                if b - a > 1e-9 and not free((a + b) / 2, y + out):
                    segments.append([[a, y], [b, y]])
    return np.array(segments)


def cast(
    segments: np.ndarray, x: float, y: float, angles: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance along each ray to the first segment, and how near to an end.

    angles: global, ``[rays]``. Distances are clipped at ``reach``; the second answer is the
    least distance of each ray from an end of a segment.
    """
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]
    start, along = segments[:, 0] - [x, y], segments[:, 1] - segments[:, 0]
    cross = direction[..., 0] * along[:, 1] - direction[..., 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
        u = (start[:, 0] * direction[..., 1] - start[:, 1] * direction[..., 0]) / cross
    hit = (t >= 0) & (u >= 0) & (u <= 1)
    distance = np.minimum(np.where(hit, t, np.inf).min(axis=1), reach)

    ends = segments.reshape(-1, 2) - [x, y]
    ahead = direction[..., 0] * ends[:, 0] + direction[..., 1] * ends[:, 1]
    aside = np.abs(direction[..., 0] * ends[:, 1] - direction[..., 1] * ends[:, 0])
    return distance, np.where(ahead > 0, aside, np.inf).min(axis=1)


def _halls(draw: st.DrawFn, width: float, count: int) -> list[float]:
    hundredths = st.integers(round(200 * width), 2000)
    return [draw(hundredths) / 100 for _ in range(count)]


@st.composite
def open_tracks(draw: st.DrawFn) -> Track:
    """Draw tracks with up to four turns, left or right, and a dead end."""
    turns = draw(st.lists(st.sampled_from(["left", "right"]), max_size=4))
    width = draw(st.sampled_from([1.0, 1.3, 1.5, 2.0]))
    lengths = _halls(draw, width, len(turns) + 1)
    halls = [Hall(a, b) for a, b in zip(lengths, [*turns, None], strict=True)]
    try:
        return Track(width, tuple(halls), closed=False)
    except BadInput as error:
        assume("meet" not in str(error))
        raise


@st.composite
def closed_tracks(draw: st.DrawFn) -> Track:
    """Draw rectangles, driven either way round."""
    width, turn = draw(st.sampled_from([1.0, 1.5])), draw(st.sampled_from(["left", "right"]))
    hundredths = st.integers(round(300 * width), 2000)
    a, b = draw(hundredths) / 100, draw(hundredths) / 100
    return Track(width, tuple(Hall(x, turn) for x in (a, b, a, b)))


TRACKS = st.one_of(open_tracks(), closed_tracks())

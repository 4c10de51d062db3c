"""The track: hallways joined by 90-degree turns, and the local frame of each.

In the local frame of a hall, ``s`` is the distance to its left wall, ``f`` the distance
to its front wall and ``theta`` the heading, 0 along the hall, counter-clockwise
positive. Coordinates are kept as exact fractions until the last moment, so that a wall
of one hall and the same wall seen from the next are the same number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.cover import Rectangle, cover_complement
from racecar.errors import BadInput
from racecar.polygon import Array, Polygon

#: A car this far into the next hall (metres) is described in that hall's frame.
ADVANCE_DISTANCE = 5.0

_TURNS = {"right": -1, "left": 1, None: 0}
_QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # (cos, sin) of 0, 90, 180, 270 degrees


@dataclass(frozen=True)
class Hall:
    """A hallway.

    length: metres, both corner squares included (the outer side of the paper's square);
    turn: "right", "left", or None for a dead end (only in the last hall).
    """

    length: float
    turn: str | None


@dataclass(frozen=True)
class Advance:
    """The change from one hall's frame to the next.

    Taken when ``guard[0] s + guard[1] f > guard[2]`` at the end of a control step:
    ``(s, f) <- matrix @ (s, f) + offset``, ``theta <- theta + rotation``.
    """

    guard: tuple[float, float, float]
    to: int
    matrix: tuple[tuple[float, float], tuple[float, float]]
    offset: tuple[float, float]
    rotation: float


@dataclass(frozen=True)
class Frame:
    """What the car can meet, in the local frame of one hall."""

    obstacles: tuple[Polygon, ...]
    advance: Advance | None


@dataclass(frozen=True)
class _Pose:
    """Where a hall's frame lies: corner of left and front wall, quarter turns."""

    x: Fraction
    y: Fraction
    quarter: int

    def axes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        ahead = _QUARTERS[self.quarter % 4]
        return ahead, (-ahead[1], ahead[0])

    def to_global(self, s: Fraction, f: Fraction) -> tuple[Fraction, Fraction]:
        ahead, left = self.axes()
        return (self.x - f * ahead[0] - s * left[0], self.y - f * ahead[1] - s * left[1])

    def to_local(self, x: Fraction, y: Fraction) -> tuple[Fraction, Fraction]:
        ahead, left = self.axes()
        dx, dy = self.x - x, self.y - y
        return dx * left[0] + dy * left[1], dx * ahead[0] + dy * ahead[1]


@dataclass(frozen=True)
class Track:
    """Hallways of one width, each turning left or right into the next.

    width: metres; halls: in driving order; closed: whether the last hall turns into the
    first. Raises BadInput if the halls are too short, meet themselves, or do not close.
    """

    width: float
    halls: tuple[Hall, ...]
    closed: bool = True

    def __post_init__(self) -> None:
        if not self.halls:
            raise BadInput("track: it has no halls; give at least one")
        if not (math.isfinite(self.width) and self.width > 0):
            raise BadInput(f"track: width is {self.width}; it must be a positive length")
        for i, hall in enumerate(self.halls):
            last_open = i == len(self.halls) - 1 and not self.closed
            if hall.turn not in _TURNS or (hall.turn is None) != last_open:
                wanted = "null (a dead end)" if last_open else '"right" or "left"'
                raise BadInput(f"track: hall {i} has turn {hall.turn!r}; it must be {wanted}")
            if not (math.isfinite(hall.length) and hall.length >= 2 * self.width):
                raise BadInput(
                    f"track: hall {i} is {hall.length} m long; "
                    f"it must be at least two widths ({2 * self.width} m)"
                )
        if self.closed and self._pose_after(len(self.halls) - 1) != self._poses[0]:
            raise BadInput(
                "track: the last hall does not lead back to the first; "
                'correct the lengths or set "closed" to false'
            )
        self._check_disjoint()

    @cached_property
    def _width(self) -> Fraction:
        return Fraction(repr(float(self.width)))

    def _length(self, index: int) -> Fraction:
        return Fraction(repr(float(self.halls[index % len(self.halls)].length)))

    @cached_property
    def _poses(self) -> tuple[_Pose, ...]:
        poses = [_Pose(Fraction(0), Fraction(0), 0)]
        for i in range(len(self.halls) - 1):
            poses.append(self._next_pose(poses[-1], i))
        return tuple(poses)

    def _next_pose(self, pose: _Pose, index: int) -> _Pose:
        width, length = self._width, self._length(index + 1)
        if self.halls[index].turn == "right":
            x, y = pose.to_global(length, Fraction(0))
        else:
            x, y = pose.to_global(width - length, width)
        return _Pose(x, y, (pose.quarter + _TURNS[self.halls[index].turn]) % 4)

    def _pose_after(self, index: int) -> _Pose:
        return self._next_pose(self._poses[index], index)

    @cached_property
    def _rectangles(self) -> tuple[Rectangle, ...]:
        rectangles = []
        for i, pose in enumerate(self._poses):
            a = pose.to_global(Fraction(0), Fraction(0))
            b = pose.to_global(self._width, self._length(i))
            rectangles.append((min(a[0], b[0]), max(a[0], b[0]), min(a[1], b[1]), max(a[1], b[1])))
        return tuple(rectangles)

    def _check_disjoint(self) -> None:
        count = len(self.halls)
        for i in range(count):
            for j in range(i + 2, count):
                if self.closed and i == 0 and j == count - 1:
                    continue
                a, b = self._rectangles[i], self._rectangles[j]
                if a[0] <= b[1] and b[0] <= a[1] and a[2] <= b[3] and b[2] <= a[3]:
                    raise BadInput(f"track: halls {i} and {j} meet; make them longer or fewer")

    @cached_property
    def walls(self) -> tuple[Polygon, ...]:
        """The walls as boxes in the global frame ``(x, y)``; they cover all but the halls."""
        return tuple(
            Polygon.from_box((float(x0), float(y0)), (float(x1), float(y1)))
            for x0, x1, y0, y1 in self._wall_boxes
        )

    @cached_property
    def _wall_boxes(self) -> tuple[Rectangle, ...]:
        return cover_complement(self._rectangles)

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """The local frame of each hall: its obstacles and the change to the next."""
        return tuple(
            Frame(self._local_walls(pose), self._advance(i)) for i, pose in enumerate(self._poses)
        )

    def _local_walls(self, pose: _Pose) -> tuple[Polygon, ...]:
        ahead, left = pose.axes()
        boxes = []
        for x0, x1, y0, y1 in self._wall_boxes:
            spans = []
            for unit in (left, ahead):
                sign, corner, ends = (
                    (unit[0], pose.x, (x0, x1)) if unit[0] else (unit[1], pose.y, (y0, y1))
                )
                spans.append(sorted(float(sign * (corner - end)) for end in ends))
            boxes.append(((spans[0][0], spans[1][0]), (spans[0][1], spans[1][1])))
        # Sorted, so that frames of the same shape list their walls in the same order.
        return tuple(Polygon.from_box(*box) for box in sorted(boxes))

    def _advance(self, index: int) -> Advance | None:
        hall = self.halls[index]
        if hall.turn is None:
            return None
        width, to = self.width, (index + 1) % len(self.halls)
        length = self.halls[to].length
        distance = min(ADVANCE_DISTANCE, length / 2)
        if hall.turn == "right":
            guard, matrix = (1.0, 0.0, distance), ((0.0, 1.0), (-1.0, 0.0))
            offset = (0.0, length)
        else:
            guard, matrix = (-1.0, 0.0, distance - width), ((0.0, -1.0), (1.0, 0.0))
            offset = (width, float(self._length(to) - self._width))
        rotation = math.pi / 2 if hall.turn == "right" else -math.pi / 2
        return Advance(guard, to, matrix, offset, rotation)

    def to_global(
        self, frame: ArrayLike, s: ArrayLike, f: ArrayLike, theta: ArrayLike
    ) -> tuple[Array, Array, Array]:
        """Return global x, y (metres) and heading (radians) of local states, same shapes.

        The first hall runs along +x; its left front corner is the origin.
        """
        poses = [self._poses[i] for i in range(len(self.halls))]
        frame = np.asarray(frame, dtype=int)
        origin = np.array([[float(p.x), float(p.y)] for p in poses])[frame]
        ahead = np.array([p.axes()[0] for p in poses], dtype=float)[frame]
        left = np.array([p.axes()[1] for p in poses], dtype=float)[frame]
        quarter = np.array([p.quarter for p in poses])[frame]
        s, f = np.asarray(s, dtype=float)[..., None], np.asarray(f, dtype=float)[..., None]
        point = origin - f * ahead - s * left
        return point[..., 0], point[..., 1], np.asarray(theta) + quarter * (math.pi / 2)

    @property
    def alike(self) -> NDArray[np.intp]:
        """For each frame the first frame with the same shape (walls and advance): ``[halls]``."""
        seen: dict[object, int] = {}
        first = []
        for i, frame in enumerate(self.frames):
            walls = tuple(tuple(map(tuple, p.to_constraints())) for p in frame.obstacles)
            step = frame.advance
            shape = step and (step.guard, step.matrix, step.offset, step.rotation)
            first.append(seen.setdefault((walls, shape), i))
        return np.array(first)


def square_track(length: float = 20.0, width: float = 1.5) -> Track:
    """Return the paper's track: four equal halls, four right turns (lengths in metres)."""
    return Track(width, (Hall(length, "right"),) * 4)


def track_from_turns(
    turns: Sequence[str], length: float = 20.0, width: float = 1.5, closed: bool = False
) -> Track:
    """Return a track of equal halls with the given turns ("right", "left").

    An open track gets a last hall that ends in a wall.
    """
    halls = [Hall(length, turn) for turn in turns]
    return Track(width, tuple(halls if closed else [*halls, Hall(length, None)]), closed)

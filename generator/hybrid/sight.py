"""What the LiDAR can meet, as cases: zones of the hall, and in each the faces to look at.

With the car at p, constraint ``a . p <= b`` of a wall is missed by ``g = a . p - b``; along a
ray it shrinks by ``h`` per metre. A ray meets the face of constraint j at the distance g_j /
h_j, which is a point of the wall if every other constraint m of it holds there:

    g_m - h_m g_j / h_j <= 0,  that is, with h_j > 0:  g_m h_j - h_m g_j <= 0

and it is nearer than the candidate ``n / z`` if ``g_j z - n h_j <= 0``. With g_j > 0, n >= 0
and z > 0 that also says that h_j is positive. So the nearest hit is found face by face, and every
question is the sign of a polynomial in the position and in sine and cosine of the heading.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from racecar.errors import BadInput
from racecar.instance import Constraint, FrameData
from racecar.polygon import Polygon

#: Least s, least f, largest s, largest f (metres).
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Face:
    """A face of a wall.

    face: its constraint ``[a_s, a_f, b]``; others: the wall's other constraints, as far as they
    may fail within reach.
    """

    face: Constraint
    others: tuple[Constraint, ...]

    @property
    def outside(self) -> bool:
        """Whether the car is known to be outside the constraint: it is not in the wall."""
        return not self.others


@dataclass(frozen=True)
class Zone:
    """A part of a hall and the faces in reach there.

    where: which positions belong to it, all of ``a_s s + a_f f <relation> b``.
    """

    where: tuple[tuple[float, float, str, float], ...]
    faces: tuple[Face, ...]


def zones(frame: FrameData, reach: float) -> tuple[Zone, ...]:
    """Cut the places where a scan may be taken into zones, by which walls are within reach.

    reach: range of the LiDAR, metres. Every place outside of the walls belongs to exactly one
    zone: a strip across the hall or, where the frame is to be left already (only a car that
    starts there, or drives the track the wrong way round, is measured there), one more.
    """
    walls = [Polygon.from_constraints(wall) for wall in frame.obstacles]
    hall = _bounds(frame)
    if frame.advance is None:
        return _strips(frame, walls, hall, (), reach)
    a_s, a_f, b = frame.advance.guard
    left = _cut(hall, (-a_s, -a_f, -b))
    rest = Zone(((a_s, a_f, ">", b),), _faces(walls, left, reach))
    here = ((a_s, a_f, "<=", b),)
    return (*_strips(frame, walls, _cut(hall, frame.advance.guard), here, reach), rest)


def _strips(
    frame: FrameData, walls: Sequence[Polygon], hall: Box, where: tuple, reach: float
) -> tuple[Zone, ...]:
    """Cut a hall into strips across it; the outermost ones have no end."""
    _, f0, _, f1 = hall
    ends = {b / a_f for wall in frame.obstacles for _, a_f, b in wall if a_f}
    marks = {end + sign * reach for end in ends for sign in (-1, 1)}
    cuts = [f0, *sorted(x for x in marks if f0 < x < f1), f1]
    strips = list(pairwise(cuts))

    def faces(strip: tuple[float, float]) -> tuple[Face, ...]:
        return _faces(walls, (hall[0], strip[0], hall[2], strip[1]), reach)

    def work(strip: tuple[float, float]) -> float:
        return len(faces(strip)) * (strip[1] - strip[0])

    while len(strips) > 1:
        narrow = [i for i, (a, b) in enumerate(strips) if b - a < reach / 2]
        if not narrow:
            break
        _join(strips, narrow[0], work)
    found = []
    for i, strip in enumerate(strips):
        above = ((0.0, 1.0, ">", strip[0]),) if i > 0 else ()
        below = ((0.0, 1.0, "<=", strip[1]),) if i < len(strips) - 1 else ()
        found.append(Zone((*where, *above, *below), faces(strip)))
    return tuple(found)


def _join(
    strips: list[tuple[float, float]], i: int, work: Callable[[tuple[float, float]], float]
) -> None:
    """Join strip i to the neighbour with which there is less to look at."""
    options = []
    for j in (i - 1, i):
        if 0 <= j < len(strips) - 1:
            joined = (strips[j][0], strips[j + 1][1])
            options.append((work(joined) - work(strips[j]) - work(strips[j + 1]), j, joined))
    _, j, joined = min(options)
    strips[j : j + 2] = [joined]


def _bounds(frame: FrameData) -> Box:
    """Return a box that holds the whole track: its sides are the walls that are half-planes."""
    box = (-math.inf, -math.inf, math.inf, math.inf)
    for wall in frame.obstacles:
        if len(wall) == 1:
            a_s, a_f, b = wall[0]
            box = _cut(box, (-a_s, -a_f, -b))
    if not all(map(math.isfinite, box)):
        raise BadInput("plant.frames: the walls do not close the track in on all sides")
    return box


def _cut(box: Box, row: Constraint) -> Box:
    """Return a box that holds the points of ``box`` with ``a . p <= b``."""
    a_s, a_f, b = row
    bounds = list(box)
    if (a_s == 0) != (a_f == 0):
        axis, slope = (0, a_s) if a_s else (1, a_f)
        if slope > 0:
            bounds[2 + axis] = min(bounds[2 + axis], b / slope)
        else:
            bounds[axis] = max(bounds[axis], b / slope)
    return bounds[0], bounds[1], bounds[2], bounds[3]


def _faces(walls: Sequence[Polygon], box: Box, reach: float) -> tuple[Face, ...]:
    """Return the faces that a ray of length ``reach`` from a point of the box may meet."""
    lower, upper = np.array(box[:2]), np.array(box[2:])
    faces = []
    for wall in walls:
        near = wall.relevant(lower, upper, reach)
        if near is None:
            continue
        rows = [(a, f, b) for a, f, b in near.to_constraints()]
        for row in rows:
            if _outside_somewhere(row, box):
                faces.append(Face(row, tuple(other for other in rows if other != row)))
    return tuple(faces)


def _outside_somewhere(row: Constraint, box: Box) -> bool:
    """Tell whether a point of the box misses a constraint: else no ray comes in through it."""
    a_s, a_f, b = row
    most = max(a_s * s + a_f * f for s in box[::2] for f in box[1::2])
    return most > b


def alike(frames: Sequence[FrameData], unsafe: Sequence[object]) -> list[int]:
    """Return for each frame the first one that behaves the same from there on.

    Frames behave the same if walls, unsafe sets and changes of frame agree, and the frames that
    they lead to behave the same.
    """

    def shape(i: int) -> object:
        step = frames[i].advance
        change = step and (step.guard, step.matrix, step.offset, step.rotation)
        return (repr(frames[i].obstacles), repr(change), repr(unsafe[i]))

    keys: list[object] = [shape(i) for i in range(len(frames))]
    while True:
        first = {key: i for i, key in reversed(list(enumerate(keys)))}
        classes = [first[key] for key in keys]
        finer: list[object] = [
            (classes[i], classes[f.advance.to] if f.advance else None) for i, f in enumerate(frames)
        ]
        if len(set(finer)) == len(set(classes)):
            return classes
        keys = finer


def check_walls_unsafe(frames: Sequence[FrameData], unsafe: Sequence[Sequence]) -> None:
    """Refuse an unsafe set that leaves out part of a wall.

    What the car measures inside a wall is left out of the automaton; that is right because it
    is unsafe there already.
    """
    for i, frame in enumerate(frames):
        for wall in frame.obstacles:
            if not any(_contains(polygon, wall) for polygon in unsafe[i]):
                raise BadInput(
                    f"property.unsafe: frame {i} has a wall that is not inside one unsafe polygon; "
                    "hybrid automata are made only for properties that include the walls"
                )


def _contains(outer: Sequence[Constraint], inner: Sequence[Constraint]) -> bool:
    """Tell whether one constraint of ``inner`` implies each one of ``outer`` (all are boxes)."""
    return all(any(_implies(given, wanted) for given in inner) for wanted in outer)


def _implies(given: Constraint, wanted: Constraint) -> bool:
    """Tell whether ``given`` implies ``wanted``: the same normal and no larger offset."""
    return tuple(given[:2]) == tuple(wanted[:2]) and given[2] <= wanted[2]

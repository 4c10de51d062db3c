"""Safety: unsafe sets, clearance, and the exact least margin along an arc.

An unsafe set is a union of convex polygons, one list per frame. The margin of a point is
the least, over the polygons, of the largest amount by which one of the polygon's
constraints is missed: positive outside, at most 0 inside. For the property ``clearance``
that is the distance to the nearest wall (maximum norm) minus 0.3 m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from racecar.bicycle import Arc
from racecar.errors import BadInput
from racecar.polygon import Array, Polygon, Stack, bounding_box, pair, stacked
from racecar.track import Track

#: The distance (metres) that the car keeps from every wall.
CLEARANCE = 0.3
#: For so few points bounding boxes cost more than they save.
_FEW = 64

PROPERTIES = {
    "clearance": "the car keeps 0.3 m from every wall",
    "hscc20": "the set of the paper's own runs: at the inner corner the car keeps 0.3 m "
    "from one of the two faces only while it is beside that face",
}


@dataclass(frozen=True)
class Property:
    """A named unsafe set; ``unsafe[i]`` holds the polygons of frame i."""

    name: str
    unsafe: tuple[tuple[Polygon, ...], ...]

    @cached_property
    def alike(self) -> NDArray[np.intp]:
        """For each frame the first frame with the same unsafe set: ``[frames]``."""
        seen: dict[object, int] = {}
        return np.array(
            [
                seen.setdefault(repr([p.to_constraints() for p in polygons]), i)
                for i, polygons in enumerate(self.unsafe)
            ]
        )


def named_property(name: str, track: Track) -> Property:
    """Return the property ``clearance`` or ``hscc20`` on a track; BadInput for other names."""
    if name not in PROPERTIES:
        raise BadInput(f"property {name!r} is unknown; choose one of {', '.join(PROPERTIES)}")
    inflate = _inflate_all if name == "clearance" else _inflate_each_axis
    unsafe = tuple(
        tuple(grown for wall in frame.obstacles for grown in inflate(wall))
        for frame in track.frames
    )
    return Property(name, unsafe)


def _inflate_all(wall: Polygon) -> list[Polygon]:
    return [Polygon(wall.normals, _round(wall.offsets + CLEARANCE))]


def _inflate_each_axis(wall: Polygon) -> list[Polygon]:
    grown = []
    for axis in (0, 1):
        along = wall.normals[:, axis] != 0
        if along.any():
            grown.append(Polygon(wall.normals, _round(wall.offsets + CLEARANCE * along)))
    return grown


def _round(offsets: Array) -> Array:
    """Drop the rounding of the sum: -1.5 + 0.3 is to read -1.2."""
    return np.round(offsets, 9)


def margin(unsafe: Sequence[Polygon], s: Array, f: Array) -> Array:
    """Return the margin (metres) of points s, f: same shape."""
    s, f = np.asarray(s, dtype=float), np.asarray(f, dtype=float)
    stack, points = stacked(unsafe), pair(s.ravel(), f.ravel())
    if s.size > _FEW:
        stack = _near(stack, bounding_box(points))
    return stack.largest(stack.misses(points)).min(axis=0).reshape(s.shape)


def arc_margin(unsafe: Sequence[Polygon], arc: Arc, below: Array | None = None) -> Array:
    """Return the least margin (metres) along each arc, ends included: ``[batch]``.

    Exact up to rounding, for arcs of any length: the least of a maximum of smooth functions
    lies at an end, at a stationary point of one of them, or where two of them cross; all are
    computed. With ``below`` the answer is ``minimum(below, margin)``, which saves the work
    where the margin is larger anyway.
    """
    if not arc.s.size:
        return np.empty(0)
    least = np.full(arc.s.shape, np.inf) if below is None else below
    # A function of slope at most 1 strays from its chord by at most this much.
    bulge = np.abs(arc.curvature) * arc.distance**2 / 8
    both = np.empty((2, 2, arc.s.size))  # (s, f) of the starts and of the ends
    both[:, 0], both[:, 1] = (arc.s, arc.f), arc.end
    points = both.reshape(2, -1)
    box = bounding_box(points)
    stack = _near(stacked(unsafe), box, float(bulge.max()), float(least.max()))
    if not len(stack.offsets):
        return least.copy()
    misses = stack.misses(points)
    at_ends = stack.largest(misses).min(axis=0).reshape(2, -1)
    least = np.minimum(least, np.minimum(at_ends[0], at_ends[1]))
    first, last = misses[:, : arc.s.size], misses[:, arc.s.size :]
    # Where a function of so bounded a curvature has a slope of 0 on the way, its ends differ by
    # at most 4 stray. Elsewhere it is lowest at an end.
    stray = stack.norms[:, None] * bulge
    stray *= np.abs(last - first) <= 4.001 * stray
    for k, bound in enumerate(stack.largest(np.minimum(first, last) - stray)):
        todo = np.flatnonzero(bound < least)
        if todo.size:
            mine = np.flatnonzero(stack.owner == stack.owner[stack.starts[k]])
            highest = np.maximum(first[mine][:, todo], last[mine][:, todo])
            highest += stack.norms[mine, None] * bulge[todo]
            mine = mine[np.any(highest >= bound[todo], axis=1)]  # the others are never largest
            polygon = Polygon(stack.normals[mine], stack.offsets[mine])
            least[todo] = np.minimum(least[todo], _inner_margin(polygon, arc.take(todo)))
    return least


def _near(stack: Stack, box: Array, stray: float = 0.0, below: float = math.inf) -> Stack:
    """Return the constraints that decide the margin of points in a box.

    stray (metres): how far points may lie outside the box; below: margins above it do not
    count. Comparisons are such that NaN keeps a polygon.
    """
    least, most = stack.bounds(box, stray)
    low, high = stack.largest(least), stack.largest(most)
    far = low > np.minimum(high.min(), below)
    return stack.take(~(far[stack.owner] | (most < low[stack.owner])))


def _inner_margin(polygon: Polygon, arc: Arc) -> Array:
    """Return the least separation from one polygon over the inner candidates of each arc."""
    with np.errstate(all="ignore"):
        candidates = [_lowest(normal, arc) for normal in polygon.normals]
        for i, j in combinations(range(len(polygon.offsets)), 2):
            normal = polygon.normals[i] - polygon.normals[j]
            candidates += _crossings(normal, polygon.offsets[i] - polygon.offsets[j], arc)
        distances = np.array(candidates)
        circle = 2 * math.pi / np.abs(arc.curvature)
        distances = np.where(distances < 0, distances + circle, distances)
    # A candidate beyond the arc, or none at all (NaN), becomes an end: harmless.
    inner = np.fmin(np.fmax(distances, 0.0), arc.distance)
    return polygon.separation(*arc.point(inner)).min(axis=0)


def _slopes(normal: Array, arc: Arc) -> tuple[Array, Array]:
    """Return the derivative of ``normal @ p`` at the start of the arc, and 90 degrees on."""
    sine, cosine = np.sin(arc.course), np.cos(arc.course)
    return -normal[0] * sine - normal[1] * cosine, -normal[0] * cosine + normal[1] * sine


def _lowest(normal: Array, arc: Arc) -> Array:
    """Return the distance, up to half a circle either way, at which ``normal @ p`` is least.

    The derivative after a turn by x is ``along cos x + across sin x``; where it is 0 the
    second derivative is positive for one of two opposite x.
    """
    along, across = _slopes(normal, arc)
    side = np.copysign(1.0, arc.curvature)
    return np.arctan2(-side * along, side * across) / arc.curvature


def _crossings(normal: Array, offset: float, arc: Arc) -> list[Array]:
    """Return the two distances at which ``normal @ p = offset`` (NaN where there is none).

    With x the angle turned and ``t = 2 tan(x / 2) / curvature`` (t = distance when straight)
    the equation is ``curvature (curvature c + 2 across) t^2 / 4 + along t + c = 0``,
    c the value at the start.
    """
    along, across = _slopes(normal, arc)
    start = normal[0] * arc.s + normal[1] * arc.f - offset
    square = arc.curvature * (arc.curvature * start + 2 * across) / 4
    root = np.sqrt(along**2 - 4 * square * start)
    # Both forms avoid cancellation; each is stable for one sign of ``along``.
    pivot = -(along + np.copysign(root, along)) / 2
    roots = []
    for t in (start / pivot, pivot / square):
        half = arc.curvature * t / 2
        roots.append(np.where(np.abs(half) < 1e-8, t, 2 * np.arctan(half) / arc.curvature))
    return roots

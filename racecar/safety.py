"""Safety: unsafe sets, clearance, and the exact least margin along an arc.

An unsafe set is a union of convex polygons, one list per frame. The margin of a point is
the least, over the polygons, of the largest amount by which one of the polygon's
constraints is missed: positive outside, at most 0 inside. For the property ``clearance``
that is the distance to the nearest wall (maximum norm) minus 0.3 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from racecar.bicycle import Arc
from racecar.errors import BadInput
from racecar.polygon import Array, Polygon
from racecar.track import Track

#: The distance (metres) that the car keeps from every wall.
CLEARANCE = 0.3

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
    return np.min([polygon.separation(s, f) for polygon in unsafe], axis=0)


def arc_margin(unsafe: Sequence[Polygon], arc: Arc, below: Array | None = None) -> Array:
    """Return the least margin (metres) along each arc, ends included: ``[batch]``.

    Exact up to rounding: the least of a maximum of smooth functions lies at an end, at a
    stationary point of one of them, or where two of them cross; all are computed. The
    heading may turn by less than 180 degrees along the arc. With ``below`` the answer is
    ``minimum(below, margin)``, which saves the work where the margin is larger anyway.
    """
    end = arc.point(arc.distance)
    least = np.full(arc.s.shape, np.inf) if below is None else below.copy()
    # An arc strays from its chord by at most this much.
    bulge = np.abs(arc.curvature) * arc.distance**2 / 8
    for polygon in unsafe:
        first, last = polygon.misses(arc.s, arc.f), polygon.misses(*end)
        np.minimum(least, np.minimum(first.max(axis=0), last.max(axis=0)), out=least)
        # On a chord a linear function is least at an end.
        bound = np.max(np.minimum(first, last), axis=0) - bulge
        todo = np.flatnonzero(bound < least)
        if todo.size:
            part = Arc(*(x[todo] for x in _fields(arc)))
            most = np.maximum(first, last)[:, todo] + bulge[todo]
            active = np.any(most >= bound[todo], axis=1)  # the others are never the largest
            lean = Polygon(polygon.normals[active], polygon.offsets[active])
            least[todo] = np.minimum(least[todo], _inner_margin(lean, part))
    return least


def _fields(arc: Arc) -> tuple[Array, ...]:
    return arc.s, arc.f, arc.course, arc.curvature, arc.distance


def _inner_margin(polygon: Polygon, arc: Arc) -> Array:
    """Return the least separation from one polygon over the inner candidates of each arc."""
    least = np.full(arc.s.shape, np.inf)
    distances = [_stationary(normal, arc) for normal in polygon.normals]
    for i, j in combinations(range(len(polygon.offsets)), 2):
        normal = polygon.normals[i] - polygon.normals[j]
        distances += _crossings(normal, polygon.offsets[i] - polygon.offsets[j], arc)
    for distance in distances:
        # A candidate outside the arc, or none at all (NaN), becomes an end: harmless.
        inner = np.clip(np.nan_to_num(distance, nan=0.0), 0.0, arc.distance)
        np.minimum(least, polygon.separation(*arc.point(inner)), out=least)
    return least


def _slopes(normal: Array, arc: Arc) -> tuple[Array, Array]:
    """Return the derivative of ``normal @ p`` at the start of the arc, and 90 degrees on."""
    sine, cosine = np.sin(arc.course), np.cos(arc.course)
    return -normal[0] * sine - normal[1] * cosine, -normal[0] * cosine + normal[1] * sine


def _stationary(normal: Array, arc: Arc) -> Array:
    """Return the distance at which ``normal @ p`` is stationary, the one nearest the start.

    The derivative after a turn by x is ``along cos x + across sin x``.
    """
    along, across = _slopes(normal, arc)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.arctan(-along / across) / arc.curvature


def _crossings(normal: Array, offset: float, arc: Arc) -> list[Array]:
    """Return the two distances at which ``normal @ p = offset`` (NaN where there is none).

    With x the angle turned and ``t = 2 tan(x / 2) / curvature`` (t = distance when straight)
    the equation is ``curvature (curvature c + 2 across) t^2 / 4 + along t + c = 0``,
    c the value at the start.
    """
    along, across = _slopes(normal, arc)
    start = normal[0] * arc.s + normal[1] * arc.f - offset
    square = arc.curvature * (arc.curvature * start + 2 * across) / 4
    roots = []
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(along**2 - 4 * square * start)
        # Both forms avoid cancellation; each is stable for one sign of ``along``.
        pivot = -(along + np.copysign(root, along)) / 2
        for t in (start / pivot, pivot / square):
            half = arc.curvature * t / 2
            turned = np.where(np.abs(half) < 1e-8, t, 2 * np.arctan(half) / arc.curvature)
            roots.append(turned)
    return roots

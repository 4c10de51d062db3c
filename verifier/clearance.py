"""A lower bound of the margin over a whole step, in continuous time.

The margin to an unsafe polygon is the largest of its misses, which is at least any weighted
mean of two of them; on a piece of the arc a linear function is at least its lesser end value
less the bulge of the arc beyond its chord, curvature length^2 / 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from racecar.polygon import Polygon
from verifier.models import Array, Models, bounds
from verifier.motion import Path
from verifier.rounding import UP, U
from verifier.rows import F, S

#: Pieces into which an arc is divided where the whole arc does not suffice.
PIECES = 16
#: An unsafe set farther away than this (metres) is not looked at more closely.
FAR = 2.0


def least_margin(path: Path, unsafe: Sequence[Polygon], wanted: float) -> Array:
    """Return a lower bound ``[rows]`` of the margin (m) along each row's path.

    The margin counts misses in the units of a polygon's own constraints: a normal of length n
    makes the bulge n times as large.

    wanted: a row whose bound on the whole arc is at least this is not refined.
    """
    if not path.curvature.radius.size:
        return np.zeros(0)
    least = _on_pieces(path, unsafe, 1)
    poor = np.flatnonzero(least < wanted)
    if poor.size:
        least[poor] = np.maximum(least[poor], _on_pieces(path.take(poor), unsafe, PIECES))
    return least


def _on_pieces(path: Path, unsafe: Sequence[Polygon], pieces: int) -> Array:
    rows = path.curvature.radius.shape[0]
    points = _points(path, pieces)
    low_c, high_c = bounds(path.curvature)
    low_d, high_d = bounds(path.distance)
    length = np.maximum(np.abs(low_d), np.abs(high_d)) / pieces
    bulge = np.maximum(np.abs(low_c), np.abs(high_c)) * length**2 / 8 * UP
    low, high = bounds(points)
    lower, upper = low.min(axis=(1, 2)), high.max(axis=(1, 2))
    least = np.full(rows, np.inf)
    # The arc strays from its chords by the bulge; 1 cm more covers the rounding of the test.
    rounding = 0.01 + 2.0**-48 * float(np.abs([lower, upper]).max())
    reach = FAR + float(bulge.max()) + rounding
    for polygon in unsafe:
        if polygon.relevant(lower, upper, reach) is None:
            least = np.minimum(least, FAR * float(_norms(polygon).min()))
            continue
        least = np.minimum(least, _polygon_margin(points, polygon, bulge))
    return least


def _points(path: Path, pieces: int) -> Models:
    """Return models ``[2, pieces + 1, rows]`` of s and f at equal distances along the arc."""
    ends = [path.start[S : F + 1]]
    ends += [path.point(i / pieces) for i in range(1, pieces)]  # pieces is a power of 2
    ends.append(path.state[S : F + 1])
    return Models(np.stack([e.c for e in ends], axis=2), np.stack([e.radius for e in ends], axis=1))


def _polygon_margin(points: Models, polygon: Polygon, bulge: Array) -> Array:
    """Return a lower bound of the margin to one polygon along all pieces, ``[rows]``."""
    misses, norms = [], _norms(polygon)
    for (a_s, a_f), b in zip(polygon.normals, polygon.offsets, strict=True):
        miss = points[0].times(float(a_s)) + points[1].times(float(a_f))
        misses.append(miss.plus(-float(b)))
    # [pieces, rows] each: the lesser end of each piece.
    bulges = [bulge * n * UP for n in norms]
    best = np.max([_piecewise(m) - x for m, x in zip(misses, bulges, strict=True)], axis=0)
    for i, j in combinations(range(len(misses)), 2):
        a, b = misses[i], misses[j]
        weight = _weight(a.c[0], b.c[0])
        useful = (weight > 0) & (weight < 1)
        if useful.any():
            best = np.maximum(best, _mixed(a, b, weight) - np.maximum(bulges[i], bulges[j]))
    # The difference rounds once more.
    return (best - 4 * U * np.abs(best)).min(axis=0)


def _norms(polygon: Polygon) -> Array:
    """Return the lengths of a polygon's normals, rounded up."""
    return np.sqrt(np.sum(polygon.normals**2, axis=1)) * UP


def _piecewise(miss: Models) -> Array:
    low = bounds(miss)[0]
    return np.minimum(low[:-1], low[1:])


def _weight(a: Array, b: Array) -> Array:
    """Return the weight of a at which both ends of a piece give the same mean, ``[pieces, rows]``.

    With a and b crossing on the piece that is the best choice; any weight in [0, 1] is sound.
    """
    da, db = a[1:] - a[:-1], b[1:] - b[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = -db / (da - db)
    return np.where(np.isfinite(weight), np.clip(weight, 0.0, 1.0), 0.0)


def _mixed(a: Models, b: Models, weight: Array) -> Array:
    """Return lower bounds of weight a + (1 - weight) b on pieces, ``[pieces, rows]``."""
    other = 1 - weight
    ends = []
    for end in (slice(None, -1), slice(1, None)):
        mean = a[end].times(weight) + b[end].times(other)
        ends.append(bounds(mean)[0])
    # 1 - weight is rounded: the weights sum to 1 within U.
    low = np.minimum(*ends)
    return low - 4 * U * np.abs(low)

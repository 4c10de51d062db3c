"""A lower bound of the margin over a whole step, in continuous time.

The margin to an unsafe polygon is the largest of its misses, which is at least any weighted
mean of two of them; on a piece of the arc a linear function is at least its lesser end value
less the bulge of the arc beyond its chord, curvature length^2 / 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from racecar.polygon import Polygon, stacked
from verifier.arithmetic import Model, bounds, read
from verifier.compiled.kernel import kernel
from verifier.compiled.trace import Trace, Value, maximum, minimum
from verifier.models import TERMS, Array, Models
from verifier.motion import Path
from verifier.rounding import UP, U
from verifier.rows import F, S
from verifier.walls import Index, grid

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
    lines = _lines(tuple(unsafe))
    least = _on_pieces(path, lines, 1)
    poor = np.flatnonzero(least < wanted)
    if poor.size:
        least[poor] = np.maximum(least[poor], _on_pieces(path.take(poor), lines, PIECES))
    return least


class _Lines:
    """The constraints of all polygons of an unsafe set.

    numbers: ``[3, lines]``, normals and offsets; norms: ``[lines]``, lengths of normals, rounded
    up; starts: where each polygon's begin; pairs: of lines of one polygon; far: ``[polygons]``.
    """

    def __init__(self, unsafe: tuple[Polygon, ...]) -> None:
        stack = stacked(unsafe)
        self.owner, self.starts = stack.owner, stack.starts
        self.numbers = np.array([*stack.normals.T, stack.offsets])
        self.norms = np.sqrt(np.sum(stack.normals**2, axis=1)) * UP
        self.far = FAR * np.minimum.reduceat(self.norms, self.starts)
        positive, negative = np.maximum(stack.normals, 0), np.minimum(stack.normals, 0)
        self.least_corner = np.concatenate([positive, negative], axis=1)
        pairs = [
            (i, j)
            for i, j in combinations(range(len(self.owner)), 2)
            if self.owner[i] == self.owner[j]
        ]
        self.pairs = np.array(pairs, dtype=np.intp).reshape(-1, 2).T

    def beyond(self, box: Array, reach: float) -> NDArray[np.bool_]:
        """Tell of each polygon whether it is farther than ``reach`` from a box (lower, upper)."""
        least = self.least_corner @ box - self.numbers[2] - reach * self.norms
        return np.logical_or.reduceat(least > 0, self.starts)


@lru_cache(maxsize=64)
def _lines(unsafe: tuple[Polygon, ...]) -> _Lines:
    return _Lines(unsafe)


def _on_pieces(path: Path, lines: _Lines, pieces: int) -> Array:
    rows, m = path.curvature.radius.shape[0], path.curvature.symbols
    points = _points(path, pieces)
    places = (pieces + 1) * rows
    width = TERMS + 2 * m
    flat = [
        table
        for i in (0, 1)
        for table in (
            points.c[:, i].reshape(width, places), points.radius[i].reshape(1, places),
        )
    ]  # fmt: skip
    hull = _hull(m)(places, flat)
    lower, upper = hull[::2].min(axis=1), hull[1::2].max(axis=1)
    curvature, distance = path.curvature, path.distance
    arc = [curvature.c, curvature.radius[None], distance.c, distance.radius[None]]
    bulge = _bulge(m, pieces)(rows, arc)[0]
    box = np.concatenate([lower, upper])
    # The arc strays from its chords by the bulge; 1 cm more covers the rounding of the test.
    rounding = 0.01 + 2.0**-48 * float(np.abs(box).max())
    beyond = lines.beyond(box, FAR + float(bulge.max()) + rounding)
    least = np.full(rows, float(lines.far[beyond].min(initial=np.inf)))
    near = np.flatnonzero(~beyond[lines.owner])
    if near.size:
        least = np.minimum(least, _polygons(lines, near, flat, m, bulge, pieces))
    return least


def _points(path: Path, pieces: int) -> Models:
    """Return models ``[2, pieces + 1, rows]`` of s and f at equal distances along the arc."""
    rows, width = path.curvature.radius.shape[0], len(path.curvature.c)
    c, radius = np.empty((width, 2, pieces + 1, rows)), np.empty((2, pieces + 1, rows))
    for place, models in ((0, path.start), (pieces, path.state)):
        c[:, :, place] = models.c[:, S : F + 1]
        radius[:, place] = models.radius[S : F + 1]
    if pieces > 1:
        inner = path.points([i / pieces for i in range(1, pieces)])  # pieces is a power of 2
        c[:, :, 1:-1], radius[:, 1:-1] = inner.c, inner.radius
    return Models(c, radius)


def _polygons(
    lines: _Lines, near: Index, flat: list[Array], m: int, bulge: Array, pieces: int
) -> Array:
    """Return a lower bound of the margin to the polygons of the lines ``near``, ``[rows]``.

    flat: the tables of points ``[2, pieces + 1, rows]``.
    """
    rows = len(bulge)
    line, point = grid(len(near), (pieces + 1) * rows)
    found = _misses(m)(len(line), [*flat, lines.numbers], [point, near[line]])
    low, centre = found.reshape(2, len(near), pieces + 1, rows)
    bulges = lines.norms[near, None, None] * bulge * UP
    best = np.minimum(low[:, :-1], low[:, 1:]) - bulges  # [lines, pieces, rows]
    place = np.full(len(lines.owner), -1)
    place[near] = np.arange(len(near))
    pairs = place[lines.pairs]
    pairs = pairs[:, pairs[0] >= 0]
    if pairs.size:
        a, b = pairs
        weight = _weight(centre[a], centre[b])
        pair, piece, row = np.nonzero((weight > 0) & (weight < 1))
        if pair.size:
            first, second = a[pair], b[pair]
            start = piece * rows + row
            indices = [start, start + rows, near[first], near[second]]
            tables = [*flat, *flat, lines.numbers, lines.numbers]
            tables.append(weight[pair, piece, row][None])
            mixed = _mixed(m)(len(pair), tables, indices)[0]
            mixed -= np.maximum(bulges[first, 0, row], bulges[second, 0, row])
            np.maximum.at(best, (first, piece, row), mixed)
    owner = lines.owner[near]
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    best = np.maximum.reduceat(best, starts, axis=0)
    # The difference rounds once more.
    return (best - 4 * U * np.abs(best)).min(axis=(0, 1))


def _weight(a: Array, b: Array) -> Array:
    """Return the weight of a at which both ends of a piece give the same mean.

    ``[pairs, pieces, rows]`` from ``[pairs, pieces + 1, rows]``. With a and b crossing on the
    piece that is the best choice; any weight in [0, 1] is sound, 0 and 1 add nothing.
    """
    da, db = a[:, 1:] - a[:, :-1], b[:, 1:] - b[:, :-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return -db / (da - db)


@kernel
def _hull(trace: Trace, symbols: int) -> list[Value]:
    """Bounds of s and of f."""
    s, f = read(trace, symbols), read(trace, symbols)
    return [*bounds(s), *bounds(f)]


@kernel
def _bulge(trace: Trace, symbols: int, pieces: int) -> list[Value]:
    """How far an arc strays from the chord of one of its pieces, at most."""
    low_c, high_c = bounds(read(trace, symbols))
    low_d, high_d = bounds(read(trace, symbols))
    length = maximum(abs(low_d), abs(high_d)) * (1 / pieces)
    return [maximum(abs(low_c), abs(high_c)) * (length * length) * 0.125 * UP]


def _miss(s: Model, f: Model, line: Sequence[Value]) -> Model:
    """What a point misses a line (normal and offset) by."""
    a_s, a_f, offset = line
    return (s.times(a_s) + f.times(a_f)).plus(-offset)


@kernel
def _misses(trace: Trace, symbols: int) -> list[Value]:
    """The lower bound and the middle of what a point misses a line by."""
    point, line = trace.index(), trace.index()
    s, f = read(trace, symbols, point), read(trace, symbols, point)
    miss = _miss(s, f, trace.table(3, line))
    return [bounds(miss)[0], miss.c[0]]


@kernel
def _mixed(trace: Trace, symbols: int) -> list[Value]:
    """A lower bound of weight a + (1 - weight) b at both ends of a piece, a and b two misses."""
    start, end, first, second = (trace.index() for _ in range(4))
    ends = [(read(trace, symbols, point), read(trace, symbols, point)) for point in (start, end)]
    numbers = [trace.table(3, line) for line in (first, second)]
    weight = trace.column()
    other = 1.0 - weight
    lows = []
    for s, f in ends:
        a, b = (_miss(s, f, line) for line in numbers)
        lows.append(bounds(a.times(weight) + b.times(other))[0])
    low = minimum(*lows)
    # 1 - weight is rounded: the weights sum to 1 within U.
    return [low - 4 * U * abs(low)]

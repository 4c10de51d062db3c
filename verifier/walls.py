"""Everything about the walls that depends on the row but not on the ray.

Seen from the car, constraint j of a wall is missed by g_j (racecar.polygon), and a ray
enters it at the rate h_j = cos(angle) A_j + sin(angle) B_j (racecar.lidar). So a ray meets
face j at inverse distance u_j = h_j / g_j, provided that the wall's other constraints k hold
there: X_jk = h_k g_j - h_j g_k >= 0, a cross product. Each of h, u, differences of two u, and X
is a pair of models per row, to be combined with the cosine and sine of a ray's angle: an entry of
one table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from racecar.polygon import Polygon, stacked
from verifier.arithmetic import Model, bounds, read, read_joined
from verifier.compiled.kernel import kernel
from verifier.compiled.trace import Trace, Value, where
from verifier.functions import reciprocal, sine_cosine
from verifier.models import TERMS, Array, Models
from verifier.models import bounds as bounds_of
from verifier.rows import THETA, F, S

Index = NDArray[np.intp]

#: A face that the car may be nearer to than this (metres) is divided by only if its distance is
#: known to within a factor of 2, and never below NEAREST.
NEAR, NEAREST = 0.02, 1e-4
#: Where error symbols (m, rad) exceed this, series of first order in them are not best any more.
WIDE = 1e-4
#: Stands for the range instead of a face: u = 1 / range.
RANGE = -1


@dataclass(frozen=True)
class Face:
    """One constraint of one obstacle: their places in the frame's lists, and its numbers."""

    polygon: int
    place: int
    normal: tuple[float, float]
    offset: float


class Faces:
    """A set of faces, and the places of their pairs of models in a table.

    pairs: the pairs (j, k), j < k, of faces of one wall, whose cross products are wanted; twos:
    all pairs, whose u are compared. Entries of the table: rates h, ratios u, differences u_j -
    u_k of ``twos``, cross products X_jk of ``pairs``.
    """

    def __init__(self, faces: Sequence[Face]) -> None:
        self.faces = tuple(faces)
        count = len(self.faces)
        self.count = count
        by_wall: dict[int, list[int]] = {}
        for j, face in enumerate(faces):
            by_wall.setdefault(face.polygon, []).append(j)
        #: The faces of each wall.
        self.walls = tuple(tuple(members) for members in by_wall.values())
        self.pairs = [pair for members in self.walls for pair in combinations(members, 2)]
        self.twos = list(combinations(range(count), 2))
        self.numbers = np.array([[*f.normal, f.offset] for f in faces]).T.copy()
        self.ratios = count
        self.differences = 2 * count
        self.crosses = 2 * count + len(self.twos)
        self.entries = self.crosses + len(self.pairs)

    @cached_property
    def two_places(self) -> tuple[Index, Index]:
        """The two faces of each of ``twos``."""
        return _columns(self.twos)

    @cached_property
    def pair_places(self) -> tuple[Index, Index]:
        """The two faces of each of ``pairs``."""
        return _columns(self.pairs)


def _columns(pairs: list[tuple[int, int]]) -> tuple[Index, Index]:
    first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return np.ascontiguousarray(first), np.ascontiguousarray(second)


class Obstacles:
    """The walls of one frame, from which the faces near a batch of rows are picked."""

    def __init__(self, polygons: Sequence[Polygon]) -> None:
        self._faces = [
            Face(p, place, (float(normal[0]), float(normal[1])), float(offset))
            for p, polygon in enumerate(polygons)
            for place, (normal, offset) in enumerate(
                zip(polygon.normals, polygon.offsets, strict=True)
            )
        ]
        stack = stacked(polygons)
        self._norms, self._offsets, self._starts = stack.norms, stack.offsets, stack.starts
        self._owner = np.array([f.polygon for f in self._faces])
        positive, negative = np.maximum(stack.normals, 0), np.minimum(stack.normals, 0)
        # Times (lower, upper): the least and the most of a . p over a box.
        self._corners = np.block([[positive, negative], [negative, positive]])
        self._known: dict[bytes, Faces] = {}

    def within(self, state: Models, reach: float) -> Faces:
        """Return the faces that matter within ``reach`` metres of any member of any row.

        Dropped are walls farther than that from all, and faces whose constraint holds
        everywhere within reach; of a wall that the cars are deep inside of, all faces are kept.
        """
        low, high = bounds_of(state[S : F + 1])
        box = np.concatenate([low.min(axis=1), high.max(axis=1)])
        # A millimetre more covers the rounding of the test itself.
        reach = reach + 1e-3 + 2.0**-48 * float(np.abs(box).max())
        least, most = (self._corners @ box).reshape(2, -1) - self._offsets
        slack = reach * self._norms
        far = np.logical_or.reduceat(least > slack, self._starts)
        keep = most + slack > 0
        deep = ~np.logical_or.reduceat(keep, self._starts)
        keep = (keep | deep[self._owner]) & ~far[self._owner]
        if not keep.any():  # one, out of reach, keeps the arrays from being empty
            first = self._owner == 0
            keep[np.flatnonzero(first)[least[first].argmax()]] = True
        key = keep.tobytes()
        if key not in self._known:
            self._known[key] = Faces([self._faces[i] for i in np.flatnonzero(keep)])
        return self._known[key]


def usable(low: Any, high: Any) -> Any:
    """Tell which faces are divided by, from bounds of g (numbers, arrays or Values)."""
    return (low > NEAR) | ((low > NEAREST) & (2.0 * low > high))


@lru_cache(maxsize=256)
def grid(outer: int, inner: int) -> tuple[Index, Index]:
    """Return the outer and the inner place of each place of a flat ``[outer, inner]``."""
    first, second = np.indices((outer, inner), dtype=np.intp)
    first, second = first.ravel(), second.ravel()
    first.flags.writeable = second.flags.writeable = False
    return first, second


class Walls:
    """The table of all entries of ``faces``, for rows.

    wide: whether the rows' errors are; table: ``[2 width, entries x rows]``, width = a model's
    coefficients and radius; low, high: ``[faces, rows]`` bounds of g; usable: ``[faces, rows]``,
    whether u has a meaning; miss_centre: ``[faces,
    rows]`` g at x = 0.
    """

    def __init__(self, faces: Faces, state: Models) -> None:
        self.faces, self.symbols = faces, state.symbols
        m, rows, count = state.symbols, state.radius.shape[-1], faces.count
        self.rows = rows
        self.wide = bool(m) and float(np.abs(state.c[TERMS::2]).max()) > WIDE
        width = TERMS + 2 * m + 1
        self.table = np.empty((2 * width, faces.entries * rows))
        turned = _heading(m)(rows, [state.c[:, THETA], state.radius[THETA : THETA + 1]])
        face, row = grid(count, rows)
        position = [table for i in (S, F) for table in (state.c[:, i], state.radius[i : i + 1])]
        seen = _faces(m)(count * rows, [*position, turned, faces.numbers], [row, face])
        self._block(0, count)[:] = seen[: 2 * width]
        misses = seen[2 * width : 3 * width]
        _ratios(m)(
            count * rows,
            [seen[: 2 * width], misses, seen[3 * width : 3 * width + 2]],
            out=self._block(faces.ratios, count),
        )
        self.low = seen[3 * width].reshape(count, rows)
        self.high = seen[3 * width + 1].reshape(count, rows)
        self.usable = usable(self.low, self.high)
        self.miss_centre = misses[0].reshape(count, rows)
        self._differences()
        self._crosses(misses)

    def _block(self, first: int, count: int) -> Array:
        return self.table[:, first * self.rows : (first + count) * self.rows]

    def _differences(self) -> None:
        faces, rows = self.faces, self.rows
        if not faces.twos:
            return
        entry, row = grid(len(faces.twos), rows)
        first, second = (places[entry] * rows + row for places in faces.two_places)
        ratios = self._block(faces.ratios, faces.count)
        out = self._block(faces.differences, len(faces.twos))
        _difference(self.symbols)(len(row), [ratios, ratios], [first, second], out)

    def _crosses(self, misses: Array) -> None:
        faces, rows = self.faces, self.rows
        if not faces.pairs:
            return
        entry, row = grid(len(faces.pairs), rows)
        first, second = (places[entry] * rows + row for places in faces.pair_places)
        rates = self._block(0, faces.count)
        out = self._block(faces.crosses, len(faces.pairs))
        _cross(self.symbols)(len(row), [rates, misses, rates, misses], [first, second], out)

    @property
    def centres(self) -> Array:
        """The pairs' constant coefficients, ``[2 entries, rows]``: all A, then all B."""
        width = len(self.table) // 2
        return self.table[[0, width]].reshape(2 * self.faces.entries, self.rows)


@kernel
def _heading(trace: Trace, symbols: int) -> list[Value]:
    theta = read(trace, symbols)
    sine, cosine = sine_cosine(theta)
    return [*sine.values, *cosine.values]


@kernel
def _faces(trace: Trace, symbols: int) -> list[Value]:
    """Rates (A, B), the miss, and its bounds, of a face and a row."""
    row, face = trace.index(), trace.index()
    s, f = read(trace, symbols, row), read(trace, symbols, row)
    sine, cosine = read_joined(trace, symbols, 2, row)
    a_s, a_f, offset = trace.table(3, face)
    miss = (s.times(a_s) + f.times(a_f)).plus(-offset)
    ahead = sine.times(a_s) + cosine.times(a_f)
    across = cosine.times(a_s) - sine.times(a_f)
    return [*ahead.values, *across.values, *miss.values, *bounds(miss)]


@kernel
def _ratios(trace: Trace, symbols: int) -> list[Value]:
    """Ratios (A, B) of rates and the miss; of no meaning where the face is not usable."""
    ahead, across = read_joined(trace, symbols, 2)
    (miss,) = read_joined(trace, symbols, 1)
    divided = usable(*trace.table(2))
    first = where(divided, miss.c[0], 1.0)
    rest = [where(divided, x, 0.0) for x in miss.values[1:]]
    inverse = reciprocal(Model([first, *rest[:-1]], rest[-1]))
    return [*(ahead * inverse).values, *(across * inverse).values]


@kernel
def _difference(trace: Trace, symbols: int) -> list[Value]:
    a = read_joined(trace, symbols, 2, trace.index())
    b = read_joined(trace, symbols, 2, trace.index())
    return [*(a[0] - b[0]).values, *(a[1] - b[1]).values]


@kernel
def _cross(trace: Trace, symbols: int) -> list[Value]:
    """X_jk = h_k g_j - h_j g_k."""
    first, second = trace.index(), trace.index()
    rates_j = read_joined(trace, symbols, 2, first)
    (miss_j,) = read_joined(trace, symbols, 1, first)
    rates_k = read_joined(trace, symbols, 2, second)
    (miss_k,) = read_joined(trace, symbols, 1, second)
    return [
        value
        for j, k in zip(rates_j, rates_k, strict=True)
        for value in (k * miss_j - j * miss_k).values
    ]

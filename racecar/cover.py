"""Cover everything outside a set of rectangles with maximal boxes: halls in, walls out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

#: x0, x1, y0, y1; an infinite bound leaves that side open.
Rectangle = tuple[Fraction | float, Fraction | float, Fraction | float, Fraction | float]


def cover_complement(free: Sequence[Rectangle]) -> tuple[Rectangle, ...]:
    """Return boxes whose union is the closure of the complement of the free rectangles.

    Each box is maximal: no other box of the answer contains it, and none could grow.
    The distance to the union (in the maximum norm, as in any other) is the least
    distance to one of the boxes.
    """
    edges_x = [-math.inf, *sorted({x for r in free for x in r[:2]}), math.inf]
    edges_y = [-math.inf, *sorted({y for r in free for y in r[2:]}), math.inf]

    def is_wall(i: int, j: int) -> bool:
        return not any(
            r[0] <= edges_x[i] and edges_x[i + 1] <= r[1]
            and r[2] <= edges_y[j] and edges_y[j + 1] <= r[3]
            for r in free
        )  # fmt: skip

    columns, rows = len(edges_x) - 1, len(edges_y) - 1
    wall = np.array([[is_wall(i, j) for j in range(rows)] for i in range(columns)])
    spans = set()
    for i, j in np.argwhere(wall):
        spans.add(_grow(wall, i, j))
        j0, j1, i0, i1 = _grow(wall.T, j, i)
        spans.add((i0, i1, j0, j1))
    maximal = sorted(a for a in spans if not any(a != b and _inside(a, b) for b in spans))
    return tuple(
        (edges_x[i0], edges_x[i1 + 1], edges_y[j0], edges_y[j1 + 1]) for i0, i1, j0, j1 in maximal
    )


_Span = tuple[int, int, int, int]  # first and last column, first and last row


def _inside(a: _Span, b: _Span) -> bool:
    return b[0] <= a[0] and a[1] <= b[1] and b[2] <= a[2] and a[3] <= b[3]


def _grow(wall: NDArray[np.bool_], i: int, j: int) -> _Span:
    """Grow cell (i, j) along the first axis, then the resulting strip along the second."""
    i0 = i1 = int(i)
    while i0 > 0 and wall[i0 - 1, j]:
        i0 -= 1
    while i1 < wall.shape[0] - 1 and wall[i1 + 1, j]:
        i1 += 1
    j0 = j1 = int(j)
    while j0 > 0 and wall[i0 : i1 + 1, j0 - 1].all():
        j0 -= 1
    while j1 < wall.shape[1] - 1 and wall[i0 : i1 + 1, j1 + 1].all():
        j1 += 1
    return i0, i1, j0, j1

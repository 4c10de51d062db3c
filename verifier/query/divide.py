"""Dividing the boxes of a question until bounds exclude a violation on every part."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from verifier.query.question import Area

Array = NDArray[np.float64]
#: The checker's bounds differ by rounding: so much is asked for beyond what has to be proved.
ROOM = 1e-9
#: Boxes that are bounded together.
BATCH = 128


@dataclass(frozen=True, eq=False)
class Found:
    """Bounds on some boxes.

    missed: by how much each condition is missed at least ``[boxes, rows]``; score: how much
    dividing an input may help each of them ``[boxes, rows, inputs]``; points: inputs that may
    violate ``[points, inputs]``.
    """

    missed: Array
    score: Array
    points: Array


#: Bounds boxes ``[boxes, inputs]`` of an area.
Bound = Callable[[Area, Array, Array], Found]
#: Tells which boxes ``[boxes, inputs]`` the checker takes for proved.
Confirm = Callable[[Array, Array], NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class Tree:
    """A division of a box: inputs ``dim`` and places ``at`` in preorder, dim -1 for a leaf."""

    dim: list[int]
    at: list[float]


class OutOfTime(Exception):
    """The time was over before all was divided finely enough."""


def divide(
    area: Area, bound: Bound, confirm: Confirm, deadline: float,
    look: Callable[[Area, Array], None], at_a_time: int = BATCH,
) -> Tree:  # fmt: skip
    """Divide an area's box until bounds exclude a violation and the checker confirms it.

    Raises OutOfTime, and whatever ``look`` raises when it is shown points that may violate.
    """
    lower, upper = [area.lower], [area.upper]
    children: dict[int, tuple[int, float, int, int]] = {}
    todo = [0]
    while todo:
        if time.monotonic() > deadline:
            raise OutOfTime
        batch, todo = todo[-at_a_time:], todo[:-at_a_time]
        lows, highs = np.array([lower[k] for k in batch]), np.array([upper[k] for k in batch])
        found = bound(area, lows, highs)
        look(area, found.points)
        rows = [_open_row(missed, area.alternative) for missed in found.missed]
        closed = np.flatnonzero([row is None for row in rows])
        proved = set(closed[confirm(lows[closed], highs[closed])]) if len(closed) else set()
        for place, k in enumerate(batch):
            if place in proved:
                continue
            row = rows[place]
            dim, at = _cut(found.score[place, 0 if row is None else row], lows[place], highs[place])
            first_high, second_low = highs[place].copy(), lows[place].copy()
            first_high[dim] = second_low[dim] = at
            first = len(lower)
            lower += [lows[place], second_low]
            upper += [first_high, highs[place]]
            children[k] = (dim, at, first, first + 1)
            todo += [first + 1, first]
    return _preorder(children)


def _open_row(missed: Array, alternative: NDArray[np.intp]) -> int | None:
    """Return the condition that comes nearest to excluding an alternative that is still open.

    None: all alternatives are excluded.
    """
    best = None
    for k in range(int(alternative.max()) + 1):
        rows = np.flatnonzero(alternative == k)
        row = int(rows[np.argmax(missed[rows])])
        if not missed[row] > ROOM and (best is None or missed[row] < missed[best]):
            best = row
    return best


def _cut(score: Array, low: Array, high: Array) -> tuple[int, float]:
    """Return which input to divide, and where: in the middle."""
    middle = 0.5 * low + 0.5 * high
    possible = (low < middle) & (middle < high)
    if not possible.any():
        raise OutOfTime
    usable = np.where(possible, np.nan_to_num(score, nan=0.0), -1.0)
    if usable.max() <= 0:
        usable = np.where(possible, high - low, -1.0)
    dim = int(np.argmax(usable))
    return dim, float(middle[dim])


def _preorder(children: dict[int, tuple[int, float, int, int]]) -> Tree:
    tree, todo = Tree([], []), [0]
    while todo:
        k = todo.pop()
        dim, at, first, second = children.get(k, (-1, 0.0, -1, -1))
        tree.dim.append(dim)
        tree.at.append(at)
        if dim >= 0:
            todo += [second, first]
    return tree

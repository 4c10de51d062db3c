"""Gathering rows that have grown together: one row that contains them all.

Pieces of a start box end up beside and upon each other where the motion forgets its start, and
pieces of a noisy motion grow into each other; what was divided is then better put together
again. The new row is a parallelotope along the principal directions of the states; the widest
of them becomes x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from verifier.arithmetic import BASE, KNOWN
from verifier.models import TERMS, Array, Models, bounds, norm
from verifier.rounding import TINY, UP
from verifier.rows import THETA, F, Rows, S, V, fresh

#: Rows are gathered if together they fill at least this share of the row that contains them.
FILL = 0.8
#: Cells along each of three axes by which that is judged.
CELLS = 12
#: A row is described anew where its later errors exceed this share of all that x and the first
#: symbols do (m), and SMALL of a metre.
STALE = 0.5
SMALL = 1e-3
#: Error symbols of a gathered row in use: all directions but x.
DIRECTIONS = 3
_ALONG = [S, F, THETA]


@dataclass(frozen=True)
class Gathered:
    """A row that contains others.

    fill: share of it that they fill, about; upper: ``[given rows]``, whether a row lies in the
    upper half along the new x.
    """

    rows: Rows
    fill: float
    upper: NDArray[np.bool_]


def gather(rows: Rows, symbols: int, note: Callable[[Rows, Rows], Rows]) -> list[Rows]:
    """Return rows that contain the given ones, which agree in frame and case: fewer, if apt.

    note(rows, whole) is told of each row that contains others, and returns it.
    """
    if len(rows) < 2:
        return [rows]
    whole = gathered(rows, symbols)
    if whole.fill >= FILL:
        return [note(rows, whole.rows)]
    if whole.upper.all() or not whole.upper.any():
        return [rows]
    halves = (rows.take(whole.upper), rows.take(~whole.upper))
    return [part for half in halves for part in gather(half, symbols, note)]


def gathered(rows: Rows, symbols: int) -> Gathered:
    """Return one row that contains all of the given ones, which agree in frame and case.

    symbols: error symbols of the new row, DIRECTIONS of them in use.
    """
    axes = _directions(rows.state)  # [4, 4], columns
    middle = rows.state.c[0].mean(axis=1)
    from_middle = [rows.state[i].plus(-middle[i]) for i in range(4)]
    along = []
    for axis in axes.T:
        total = from_middle[0].times(axis[0])
        for i in range(1, 4):
            total = total + from_middle[i].times(axis[i])
        along.append(bounds(total))
    low, high = (np.stack(x) for x in zip(*along, strict=True))  # [4, rows]
    lower, upper = low.min(axis=1), high.max(axis=1)
    half = (upper - lower) / 2 * UP + 2.0**-50 * (np.abs(lower) + np.abs(upper)) + 1e-15
    shift = axes @ ((lower + upper) / 2)
    # What the directions lack in being orthogonal, and the rounding of the new middle: the members
    # are the new row's up to this.
    size = _largest(from_middle)
    lack = np.abs(axes @ axes.T - np.eye(4)) + 2.0**-48
    rounded = np.abs(middle) + np.abs(axes) @ (np.abs(lower) + np.abs(upper))
    rest = lack @ size + 2.0**-48 * rounded
    order = np.argsort(-half)
    c = np.zeros((TERMS + 2 * symbols, 4, 1))
    c[0, :, 0] = middle + shift
    c[1, :, 0] = axes[:, order[0]] * half[order[0]]
    for j, k in enumerate(order[1:]):
        c[TERMS + 2 * j, :, 0] = axes[:, k] * half[k]
    places = np.stack([low, high])[:, order] - ((lower + upper) / 2)[order, None]
    places = places / half[order, None]
    new = fresh(
        Models(c, (rest * UP + TINY)[:, None]),
        frame=rows.frame[:1],
        low=rows.low.min(keepdims=True),
        high=rows.high.max(keepdims=True),
        least=rows.least.min(keepdims=True),
        case=rows.case[:1],
        gathered=True,
    )
    return Gathered(new, _filled(places), places[:, 0].sum(axis=0) > 0)


def stale(state: Models) -> NDArray[np.bool_]:
    """Tell of which rows of a state ``[4, rows]`` later errors are much of all there is.

    Products are known of the first symbols only.
    """
    c = state.c[:, _ALONG]
    first = (norm(c[1:TERMS]) + norm(c[TERMS : TERMS + 2 * BASE])).max(axis=0)
    later = (norm(c[TERMS + 2 * KNOWN :]) + state.radius[_ALONG]).max(axis=0)
    return np.asarray(later > STALE * np.maximum(first, SMALL))


def _filled(places: Array) -> float:
    """Return the share of the cells of a grid that boxes touch.

    places: ``[2, axes, boxes]``, lower and upper ends within [-1, 1], the widest axes first.
    """
    cells = (np.clip((places + 1) / 2, 0, 1) * CELLS)[:, :3]
    first = np.minimum(np.floor(cells[0]), CELLS - 1).astype(int)
    last = np.maximum(np.ceil(cells[1]), first + 1).astype(int)
    touched = np.zeros((CELLS,) * 3, dtype=bool)
    for (i, j, k), (a, b, c) in zip(first.T, last.T, strict=True):
        touched[i:a, j:b, k:c] = True
    return float(touched.mean())


def _largest(models: list[Models]) -> Array:
    """Return bounds ``[4]`` of the absolute values of models ``[rows]`` each."""
    return np.array([float(((norm(m.c) + m.radius) * UP).max()) for m in models])


def _directions(state: Models) -> NDArray[np.float64]:
    """Return orthonormal directions ``[4, 4]`` (columns): principal ones of s, f, theta; and v."""
    points = state.c[:, _ALONG]  # [K, 3, rows]
    middle = points[0] - points[0].mean(axis=1, keepdims=True)
    arms = np.concatenate([middle[None], points[1:TERMS:2], points[TERMS::2]])
    cloud = np.moveaxis(arms, 1, 2).reshape(-1, 3)
    axes = np.zeros((4, 4))
    # The widest first, as near as rounding lets; nothing is promised of them.
    axes[np.ix_(_ALONG, [0, 1, 2])] = np.linalg.eigh(cloud.T @ cloud)[1][:, ::-1]
    axes[V, 3] = 1.0
    return axes

"""Looking for the worst start in a box of starts."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from verifier.evolution import Evolution
from verifier.models import Array

#: Starts ``[batch, 4]`` to margins ``[batch]`` (m).
Margins = Callable[[Array], Array]

#: Starts tried at first; a round is not smaller than LEAST, for smaller ones cost as much.
FIRST, LEAST = 512, 64
#: Lowest places of a grid that are looked into, and how often at most.
VALLEYS, ZOOMS = 4, 4
#: Evolutions side by side, points of a generation of each, and generations at most.
EVOLUTIONS, POINTS, GENERATIONS = 4, 24, 40
#: The search ends where a round of it gains less than this (m).
GAIN = 1e-5


def lowest_start(
    margins: Margins, lower: Array, upper: Array, random: np.random.Generator
) -> tuple[Array, float]:
    """Return the start of the least margin found in [lower, upper], and that margin.

    The search ends at the first start whose margin is not positive.
    """
    free = np.flatnonzero(upper > lower)
    if not len(free):
        return _least(lower[None], margins(lower[None]))
    if len(free) == 1:
        return _zoom(margins, lower, upper, int(free[0]))
    return _evolve(margins, lower, upper, free, random)


def spread(lower: Array, upper: Array, count: int, random: np.random.Generator) -> Array:
    """Return ``count`` starts: the corners, as far as they go, then one in each slice of each axis.

    ``[count, 4]``, within [lower, upper] exactly.
    """
    ends = [sorted({low, high}) for low, high in zip(lower, upper, strict=True)]
    corners = np.array(list(product(*ends)))[: max(1, count // 4)]
    rest = count - len(corners)
    slices = np.stack([random.permutation(rest) for _ in range(4)], axis=1)
    inner = lower + (upper - lower) * (slices + random.random((rest, 4))) / max(rest, 1)
    return np.clip(np.concatenate([corners, inner]), lower, upper)


def _least(starts: Array, found: Array) -> tuple[Array, float]:
    worst = int(np.argmin(found))
    return starts[worst], float(found[worst])


def _zoom(margins: Margins, lower: Array, upper: Array, axis: int) -> tuple[Array, float]:
    """Search along one axis: an even grid, then finer ones around its lowest places."""

    def at(x: Array) -> Array:
        starts = np.tile(lower, (len(x), 1))
        starts[:, axis] = np.clip(x, lower[axis], upper[axis])
        return starts

    places = np.linspace(lower[axis], upper[axis], FIRST)
    found = margins(at(places))
    start, best = _least(at(places), found)
    step = (upper[axis] - lower[axis]) / (FIRST - 1)
    padded = np.concatenate([[np.inf], found, [np.inf]])
    low = np.flatnonzero((found <= padded[:-2]) & (found <= padded[2:]))
    valleys = places[low[np.argsort(found[low], kind="stable")[:VALLEYS]]]
    for _ in range(ZOOMS):
        if not best > 0 or not len(valleys):
            break
        each = max(LEAST // len(valleys), 8)
        near = valleys[:, None] + step * np.linspace(-1, 1, each)
        found = margins(at(near.ravel())).reshape(near.shape)
        before, (start, best) = (
            best,
            min((start, best), _least(at(near.ravel()), found.ravel()), key=lambda x: x[1]),
        )
        valleys = near[np.arange(len(near)), found.argmin(axis=1)]
        step = step * 2 / (each - 1)
        if before - best < GAIN:
            break
    return start, best


def _evolve(
    margins: Margins,
    lower: Array,
    upper: Array,
    free: NDArray[np.intp],
    random: np.random.Generator,
) -> tuple[Array, float]:
    """Search several axes by evolutions that begin at the best of different starts."""
    width = (upper - lower)[free]

    def at(points: Array) -> Array:
        starts = np.tile(lower, (len(points), 1))
        inner = lower[free] + points * width
        starts[:, free] = np.clip(inner, lower[free], upper[free])
        return starts

    starts = spread(lower, upper, FIRST, random)
    found = margins(starts)
    start, best = _least(starts, found)
    groups = random.permutation(FIRST).reshape(EVOLUTIONS, -1)
    leaders = starts[groups[np.arange(EVOLUTIONS), found[groups].argmin(axis=1)]]
    evolutions = [Evolution((x[free] - lower[free]) / width, 0.15, POINTS, random) for x in leaders]
    history = [best]
    for _ in range(GENERATIONS):
        if not best > 0:
            break
        points = [evolution.ask() for evolution in evolutions]
        starts = at(np.concatenate(points))
        found = margins(starts)
        start, best = min((start, best), _least(starts, found), key=lambda x: x[1])
        for evolution, own, values in zip(
            evolutions, points, found.reshape(len(points), -1), strict=True
        ):
            evolution.tell(own, values)
        history.append(best)
        evolutions = [x for x in evolutions if x.spread > 1e-9]
        if not evolutions or (len(history) > 8 and history[-9] - best < GAIN):
            break
    return start, best

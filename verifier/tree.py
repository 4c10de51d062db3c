"""Exploring what a disturbed car can reach: a tree of states, pruned to different ones.

Descent finds the bottom of a valley, but rays that jump between walls divide the pushes into
many valleys. A disturbance acts on the state through one number per step, and the state has
few dimensions: so from a start set as many different states as fit are kept at every step, each
is pushed in several ways, and of what they reach the extreme and the most different are kept.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import State, Steer
from verifier.attack import Attacks, Mask, Pushed
from verifier.models import Array
from verifier.problem import Problem

#: Pushes of each state: full left, full right, and one at random.
WAYS = 3
#: Of the leaves so many become attacks.
LEAVES = 8
#: Share of the kept states that are extreme in some direction; cells of a standard deviation.
EXTREME, CELLS = 0.5, 2.0


def grow(
    problem: Problem,
    steer: Steer,
    starts: Array,
    gone: Mask,
    mirror: int,
    random: np.random.Generator,
) -> Attacks:
    """Return the attacks of least margin in a tree as wide as there are starts, ``[width, 4]``.

    gone: rays that are missing, ``[rays]``; mirror: index of the segment that mirrors, or -1.
    The tree is cut where the car becomes unsafe.
    """
    width, steps, plant = len(starts), problem.steps, problem.plant
    state = State.start(*starts.T)
    parents: list[NDArray[np.intp]] = []
    pushes: list[Array] = []
    leaves: list[tuple[float, int, int, float]] = []  # margin, step, parent, push
    with np.errstate(invalid="ignore", over="ignore"):
        for step in range(steps):
            count = len(state)
            if not count:
                break
            push = np.concatenate([-np.ones(count), np.ones(count), random.uniform(-1, 1, count)])
            parent = np.tile(np.arange(count), WAYS)
            before = state.take(parent)
            pushed = Pushed(problem, _now(push, gone, mirror))
            scan = pushed(0, before, np.tile(plant.scan_rows(state), (1, WAYS)))
            after, arc = plant.drive(before, steer(scan))
            margins = plant.arc_margin(problem.safety, before, arc, np.full(len(parent), np.inf))
            margins = np.where(np.isnan(margins), np.inf, margins)
            least = int(margins.argmin())
            leaves.append((float(margins[least]), step, int(parent[least]), float(push[least])))
            safe = np.flatnonzero((margins > 0) & np.isfinite(after.s))
            after = plant.advance(after.take(safe))
            kept = different(after, width, random)
            state = after.take(kept)
            parents.append(parent[safe[kept]])
            pushes.append(push[safe[kept]])
    leaves = sorted(leaves)[:LEAVES]
    attacks = Attacks(
        np.empty((len(leaves), 4)),
        np.zeros((len(leaves), steps)),
        np.tile(gone, (len(leaves), 1)),
        np.full(len(leaves), mirror),
    )
    for i, (_, step, node, last) in enumerate(leaves):
        attacks.push[i, step] = last
        for earlier in range(step - 1, -1, -1):
            attacks.push[i, earlier] = pushes[earlier][node]
            node = parents[earlier][node]  # noqa: PLW2901
        attacks.start[i] = starts[node]
    return attacks


def _now(push: Array, gone: Mask, mirror: int) -> Attacks:
    """Return attacks of one step."""
    count = len(push)
    return Attacks(
        np.zeros((count, 4)), push[:, None], np.tile(gone, (count, 1)), np.full(count, mirror)
    )


def different(state: State, most: int, random: np.random.Generator) -> NDArray[np.intp]:
    """Return indices of at most about ``most`` states: extreme ones and ones far apart.

    Each hall gets its share.
    """
    count = len(state)
    if count <= most:
        return np.arange(count)
    kept = []
    for frame in np.unique(state.frame):
        own = np.flatnonzero(state.frame == frame)
        share = max(8, most * len(own) // count)
        kept.append(
            own if len(own) <= share else own[_spread(_whitened(state, own), share, random)]
        )
    return np.concatenate(kept)


def _whitened(state: State, own: NDArray[np.intp]) -> Array:
    """Return states as points of unit covariance, ``[states, dimensions]``."""
    points = np.stack([x[own] for x in (state.s, state.f, state.v, state.theta)], axis=1)
    points -= points.mean(axis=0)
    scale = points.std(axis=0)
    varies = scale > 1e-12
    points = points[:, varies] / scale[varies]
    if not varies.any():
        return np.zeros((len(own), 1))
    values, vectors = np.linalg.eigh(points.T @ points / len(points))
    wide = values > 1e-9 * values[-1]
    return points @ vectors[:, wide] / np.sqrt(values[wide])


def _spread(points: Array, count: int, random: np.random.Generator) -> NDArray[np.intp]:
    """Return indices of points: the farthest in random directions, then some of every cell."""
    directions = random.normal(size=(points.shape[1], int(count * EXTREME)))
    extreme = np.unique((points @ directions).argmax(axis=0))
    cells = np.floor((points + random.random(points.shape[1])) * CELLS).astype(np.intp)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    order = random.permutation(len(points))
    order = order[~np.isin(order, extreme)]
    order = order[np.argsort(cell.ravel()[order], kind="stable")]
    found = cell.ravel()[order]
    begins = np.flatnonzero(np.r_[True, found[1:] != found[:-1]])
    # The first of every cell, then the second of every cell, and so on.
    rank = np.arange(len(found)) - np.repeat(begins, np.diff(np.r_[begins, len(found)]))
    return np.concatenate([extreme, order[np.argsort(rank, kind="stable")][: count - len(extreme)]])

"""Looking for the worst attack: trees of states, mutations, and descents from the best of them."""

from __future__ import annotations

import numpy as np

from verifier.attack import Attacks, Mask
from verifier.descent import descend
from verifier.models import Array
from verifier.search import Search
from verifier.starts import spread
from verifier.tree import WAYS, grow

#: Attacks tried at first, mutants in each later round, and states kept in each round's tree.
FIRST, LATER, WIDTH = 512, 256, 256
#: Descents side by side; a tree takes the missing rays of one of so many of the best attacks.
ISLANDS, GOOD = 8, 3
#: Attacks that are kept from round to round; the search ends after rounds without a gain (m).
ELITE, ROUNDS_WITHOUT_GAIN, GAIN = 12, 3, 5e-5


def worst_attacks(search: Search) -> Attacks:
    """Return the attacks of the least margins found, the worst first.

    The search ends when the margin of one is not positive.
    """
    attacks = first_attacks(search)
    elite, values = _best(attacks, search.margins(attacks))
    idle = 0
    while values[0] > 0 and not search.over and idle < ROUNDS_WITHOUT_GAIN:
        new = [mutants(search, elite, LATER)]
        if search.pushed:
            new.append(_tree(search, elite))
        attacks, before = Attacks.join(new), values[0]
        margins = search.margins(attacks)
        elite, values = _best(Attacks.join([elite, attacks]), np.append(values, margins))
        if values[0] > 0:
            pool = Attacks.join([elite, attacks]), np.append(values, margins)
            reached, margins = descend(search, *_islands(search, *pool))
            elite, values = _best(Attacks.join([elite, reached]), np.append(values, margins))
        idle = 0 if values[0] < before - GAIN else idle + 1
    return elite


def _tree(search: Search, elite: Attacks) -> Attacks:
    """Return the attacks that a tree of states finds, with the missing rays of a good attack."""
    starts = spread(search.lower, search.upper, WIDTH, search.random)
    gone = elite.gone[search.random.integers(min(len(elite), GOOD))]
    search.runs -= WIDTH * WAYS
    return grow(search.problem, search.steer, starts, gone, search.random)


def first_attacks(search: Search) -> Attacks:
    """Return attacks from all over: every single missing ray, if one may be, among them."""
    rays, given = search.problem.plant.lidar.rays, search.given
    masks = random_masks(search, FIRST)
    if given.missing:
        singles = np.concatenate([np.zeros((1, rays), dtype=bool), np.eye(rays, dtype=bool)])
        if given.missing == 1:
            masks = singles[np.arange(max(FIRST, len(singles))) % len(singles)]
        else:
            masks[: min(len(singles), FIRST // 2)] = singles[: FIRST // 2]
    starts = spread(search.lower, search.upper, len(masks), search.random)
    # Corners come first, and so do the masks: mix them.
    starts = starts[search.random.permutation(len(starts))]
    return Attacks(starts, random_pushes(search, len(masks)), masks)


def random_masks(search: Search, count: int) -> Mask:
    """Return sets of rays that may be missing, most of them as large as they may be."""
    rays, most = search.problem.plant.lidar.rays, search.given.missing
    masks = np.zeros((count, rays), dtype=bool)
    if most:
        for mask in masks:
            size = most if search.random.random() < 0.75 else search.random.integers(most + 1)
            mask[search.random.choice(rays, size, replace=False)] = True
    return masks


def random_pushes(search: Search, count: int, most: int = 3) -> Array:
    """Return pushes of one strength that change sides a few times: ``[count, steps]``."""
    steps, random = search.problem.steps, search.random
    if not search.pushed:
        return np.zeros((count, steps))
    cuts = np.sort(random.integers(0, steps + 1, (count, most)), axis=1)
    cuts[random.random((count, most)) < 0.4] = steps  # fewer changes
    part = (np.arange(steps)[:, None] >= np.sort(cuts, axis=1)[:, None]).sum(axis=2)
    sides = random.choice([-1.0, 1.0, 0.0], (count, most + 1), p=[0.45, 0.45, 0.1])
    strength = random.choice([1.0, 0.5, 0.25], (count, 1), p=[0.6, 0.25, 0.15])
    return np.take_along_axis(sides, part, axis=1) * strength


def mutants(search: Search, elite: Attacks, count: int) -> Attacks:
    """Return new attacks made of good ones: crossed, changed in a few places, or all new."""
    random, steps = search.random, search.problem.steps
    parents = elite.take(random.integers(len(elite), size=count))
    start, push, gone = parents.start.copy(), parents.push.copy(), parents.gone.copy()
    others, fresh = random_pushes(search, count), random_masks(search, count)
    for i in range(count):
        kind, (begin, end) = random.random(), np.sort(random.integers(0, steps + 1, 2))
        if kind < 0.3:
            push[i, begin:] = elite.push[random.integers(len(elite)), begin:]
        elif kind < 0.6:
            push[i, begin:end] = others[i, begin:end]
        elif kind < 0.8:
            push[i] = np.roll(push[i], random.integers(-4, 5))
        elif kind < 0.9:
            push[i] = others[i]
        if random.random() < 0.3:
            gone[i] = fresh[i] if kind < 0.5 else _swapped(random, gone[i], fresh[i])
    width = (search.upper - search.lower) * random.choice([0.0, 0.003, 0.03, 0.3], (count, 1))
    start = start + width * random.normal(size=start.shape)
    new = random.random(count) < 0.25
    start[new] = spread(search.lower, search.upper, count, random)[new]
    return Attacks(np.clip(start, search.lower, search.upper), push, gone)


def _swapped(random: np.random.Generator, mask: Mask, other: Mask) -> Mask:
    """Return a mask with one of its rays replaced by one of another mask."""
    mask = mask.copy()
    mine, theirs = np.flatnonzero(mask & ~other), np.flatnonzero(other & ~mask)
    if mine.size and theirs.size:
        mask[random.choice(mine)] = False
        mask[random.choice(theirs)] = True
    return mask


def _best(attacks: Attacks, margins: Array) -> tuple[Attacks, Array]:
    order = np.argsort(margins, kind="stable")[:ELITE]
    return attacks.take(order), margins[order]


def _islands(search: Search, attacks: Attacks, margins: Array) -> tuple[Attacks, Array]:
    """Return the best attack, and the best of each of several random groups."""
    order = search.random.permutation(len(attacks))
    order = np.concatenate([[margins.argmin()], order[order != margins.argmin()]])
    groups = np.array_split(order[1:], ISLANDS - 1)
    leaders = np.array([order[0], *(g[margins[g].argmin()] for g in groups if len(g))])
    return attacks.take(leaders), margins[leaders]

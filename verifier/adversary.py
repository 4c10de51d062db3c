"""Looking for the worst attack: trees of states, mutations, and descents from the best of them.

What is chosen once for the run (missing rays, the stretch that mirrors) is tried choice by choice
first; later the neighbours of the best choices are, and for the best of them the start is searched
as if nothing else could change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from verifier.attack import Attacks
from verifier.descent import descend
from verifier.faultsets import (
    FaultSets,
    every_choice,
    neighbours,
    random_choices,
    swapped,
)
from verifier.models import Array
from verifier.search import Search
from verifier.starts import lowest_start, spread
from verifier.tree import WAYS, grow

#: Attacks tried at first, mutants in each later round, and states kept in each round's tree.
FIRST, LATER, WIDTH = 512, 256, 256
#: Descents side by side; a tree takes the missing rays of one of so many of the best attacks.
ISLANDS, GOOD = 8, 3
#: Attacks that are kept from round to round; the search ends after rounds without a gain (m).
ELITE, ROUNDS_WITHOUT_GAIN, GAIN = 12, 3, 5e-5
#: In each round so many attacks are looked at with all their neighbours, and with all starts.
LOOKED_AT = 2


def worst_attacks(search: Search) -> Attacks:
    """Return the attacks of the least margins found, the worst first.

    The search ends when the margin of one is not positive.
    """
    elite, values = _worst(search)
    while search.again and values[0] > 0 and not search.over:
        more, found = _worst(search)
        elite, values = _best(Attacks.join([elite, more]), np.append(values, found))
    return elite


def _worst(search: Search) -> tuple[Attacks, Array]:
    """Search once, until nothing is gained any more: the best attacks and their margins."""
    elite, values = _begin(search)
    idle, seen = 0, set[bytes]()
    # Pushes would have to change with the start: then it is looked for along a line only.
    every_start = not search.pushed or np.count_nonzero(search.upper > search.lower) <= 1
    while values[0] > 0 and not search.over and idle < ROUNDS_WITHOUT_GAIN:
        new = [mutants(search, elite, LATER), *_near(search, elite, seen)]
        if search.pushed:
            new.append(_tree(search, elite))
        attacks, before = Attacks.join(new), values[0]
        margins = search.margins(attacks)
        elite, values = _best(Attacks.join([elite, attacks]), np.append(values, margins))
        if values[0] > 0:
            pool = Attacks.join([elite, attacks]), np.append(values, margins)
            reached, margins = descend(search, *_islands(search, *pool))
            elite, values = _best(Attacks.join([elite, reached]), np.append(values, margins))
        for attack in _unseen(elite, seen, b"all starts") if every_start else []:
            if not values[0] > 0 or search.over:
                break
            attack, margin = _lowest(search, attack)  # noqa: PLW2901
            elite, values = _best(Attacks.join([elite, attack]), np.append(values, margin))
        idle = 0 if values[0] < before - GAIN else idle + 1
    return elite, values


def _begin(search: Search) -> tuple[Attacks, Array]:
    """Try the first attacks, in portions: the search may be over, or at its end."""
    attacks = first_attacks(search)
    elite, values = attacks.take(slice(0)), np.empty(0)
    for first in range(0, len(attacks), FIRST):
        some = attacks.take(slice(first, first + FIRST))
        elite, values = _best(Attacks.join([elite, some]), np.append(values, search.margins(some)))
        if search.over or not values[0] > 0:
            break
    return elite, values


def _unseen(elite: Attacks, seen: set[bytes], purpose: bytes) -> list[Attacks]:
    """Return the best attacks of which no other start was looked at before, and note them."""
    found: list[Attacks] = []
    for i in range(len(elite)):
        one = elite.take(slice(i, i + 1))
        key = purpose + one.push.tobytes() + one.gone.tobytes() + one.mirror.tobytes()
        if key not in seen and len(found) < LOOKED_AT:
            seen.add(key)
            found.append(one)
    return found


def _near(search: Search, elite: Attacks, seen: set[bytes]) -> list[Attacks]:
    """Return good attacks with other choices, each a neighbour of its own."""
    found: list[Attacks] = []
    for attack in _unseen(elite, seen, b"neighbours"):
        sets = neighbours(search, attack.gone[0], int(attack.mirror[0]))
        if len(sets) > LATER:
            sets = sets.take(search.random.choice(len(sets), LATER, replace=False))
        found.append(replace(attack.repeated(len(sets)), gone=sets.gone, mirror=sets.mirror))
    return found


def _lowest(search: Search, attack: Attacks) -> tuple[Attacks, float]:
    """Return the worst start for what an attack does, and its margin."""

    def at(starts: Array) -> Attacks:
        return replace(attack.repeated(len(starts)), start=starts)

    start, margin = lowest_start(
        lambda starts: search.margins(at(starts)), search.lower, search.upper, search.random
    )
    return at(start[None]), margin


def _tree(search: Search, elite: Attacks) -> Attacks:
    """Return the attacks that a tree of states finds, with the choices of a good attack."""
    starts = spread(search.lower, search.upper, WIDTH, search.random)
    parent = search.random.integers(min(len(elite), GOOD))
    gone, mirror = elite.gone[parent], int(elite.mirror[parent])
    search.runs -= WIDTH * WAYS
    return grow(search.problem, search.steer, starts, gone, mirror, search.random)


def first_attacks(search: Search) -> Attacks:
    """Return attacks from all over: every choice for the run among them, as far as they go."""
    sets, random = every_choice(search), search.random
    if len(sets) > (room := max(FIRST, search.runs // 2)):
        sets = sets.take(np.arange(room))
    if (more := FIRST - len(sets)) > 0:
        # Few choices: each of them several times; with many rays some larger sets, too.
        again = sets.take(np.arange(more) % len(sets))
        if search.given.missing > 1:
            again = random_choices(search, more)
        sets = FaultSets.join(sets, again)
    elif search.given.missing > 1:
        sets = FaultSets.join(random_choices(search, FIRST), sets)
    starts = spread(search.lower, search.upper, len(sets), random)
    # Corners come first, and so do the small sets: mix them.
    starts = starts[random.permutation(len(starts))]
    return Attacks(starts, random_pushes(search, len(sets)), sets.gone, sets.mirror)


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
    others, fresh = random_pushes(search, count), random_choices(search, count)
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
            gone[i] = fresh.gone[i] if kind < 0.5 else swapped(random, gone[i], fresh.gone[i])
    mirror = np.where(random.random(count) < 0.2, fresh.mirror, parents.mirror)
    width = (search.upper - search.lower) * random.choice([0.0, 0.003, 0.03, 0.3], (count, 1))
    start = start + width * random.normal(size=start.shape)
    new = random.random(count) < 0.25
    start[new] = spread(search.lower, search.upper, count, random)[new]
    return Attacks(np.clip(start, search.lower, search.upper), push, gone, mirror)


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

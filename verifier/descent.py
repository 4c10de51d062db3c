"""Descents from several attacks at once, by differences over the start and all steps.

Margins are not smooth in them (rays jump between walls): differences are large, and steps down
are tried in several lengths.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from verifier.attack import Attacks
from verifier.models import Array
from verifier.search import Search

#: Steps of a descent at most; after so many the worse half of the islands is left.
DESCENTS, HALVED = 16, 2
#: A step that gains less (m) is none.
GAIN = 5e-6
#: Pushes are varied in at most so many blocks of steps.
BLOCKS = 70
#: How far starts move, of the box; how many of the strongest pushes move, and how far.
_START_MOVES = (0.3, 0.1, 0.03, 0.01, 0.001)
_PUSH_MOVES = ((1, 1.0), (4, 1.0), (16, 1.0), (70, 1.0), (8, 0.3), (70, 0.3), (70, 0.1))
#: Starts are varied by this much, of the box.
_NUDGE = 1e-3


def descend(search: Search, attacks: Attacks, margins: Array) -> tuple[Attacks, Array]:
    """Descend from several attacks at once; islands that fall behind are left where they are.

    Returns the attacks reached, and their margins.
    """
    ended: list[tuple[Attacks, Array]] = []
    idle = np.zeros(len(attacks), dtype=int)
    for step in range(DESCENTS):
        if search.over or not margins.min() > 0:
            break
        flip = search.picks if step % 2 == 0 else not search.picks
        attacks, gain, margins = _step(search, attacks, margins, flip)
        idle = np.where(gain > GAIN, 0, idle + 1)
        going = idle < (2 if search.pushed else 1)
        if (step + 1) % HALVED == 0:
            going &= margins <= np.median(margins)
        ended.append((attacks.take(~going), margins[~going]))
        attacks, margins, idle = attacks.take(going), margins[going], idle[going]
        if not len(attacks):
            break
    ended.append((attacks, margins))
    return Attacks.join([a for a, _ in ended]), np.concatenate([m for _, m in ended])


def _step(
    search: Search, attacks: Attacks, margins: Array, flip: bool
) -> tuple[Attacks, Array, Array]:
    """Do one step of descent for every attack: what it reaches, its gain, its margin."""
    varied = [_varied(search, attacks.take(slice(i, i + 1)), flip) for i in range(len(attacks))]
    found = _split(search.margins(Attacks.join(varied)), varied)
    moved = [
        _moved(search, attacks.take(slice(i, i + 1)), varied[i], found[i] - margins[i])
        for i in range(len(attacks))
    ]
    reached = _split(search.margins(Attacks.join(moved)), moved)
    best, values = [], []
    for i in range(len(attacks)):
        own = attacks.take(slice(i, i + 1))
        every = Attacks.join([own, varied[i], moved[i]])
        every_margin = np.concatenate([margins[i : i + 1], found[i], reached[i]])
        least = int(every_margin.argmin())
        best.append(every.take(slice(least, least + 1)))
        values.append(every_margin[least])
    after = np.array(values)
    return Attacks.join(best), margins - after, after


def _split(values: Array, parts: list[Attacks]) -> list[Array]:
    return np.split(values, np.cumsum([len(part) for part in parts])[:-1])


def _blocks(search: Search) -> list[NDArray[np.intp]]:
    steps = search.problem.steps
    return np.array_split(np.arange(steps), min(steps, BLOCKS)) if search.pushed else []


def _varied(search: Search, attack: Attacks, flip: bool) -> Attacks:
    """Return an attack varied block by block, then coordinate by coordinate of the start.

    flip: whether pushes change sides; else they change by half of their range.
    """
    blocks, free = _blocks(search), np.flatnonzero(search.upper > search.lower)
    count = len(blocks) + 2 * len(free)
    start, push = np.repeat(attack.start, count, axis=0), np.repeat(attack.push, count, axis=0)
    for i, block in enumerate(blocks):
        old = attack.push[0, block]
        push[i, block] = np.where(old > 0, -1.0, 1.0) if flip else old - 0.5 * _side(old)
    width = search.upper - search.lower
    for i, axis in enumerate(free):
        for j, side in enumerate((-1, 1)):
            start[len(blocks) + 2 * i + j, axis] += side * _NUDGE * width[axis]
    start = np.clip(start, search.lower, search.upper)
    return replace(attack.repeated(count), start=start, push=push)


def _side(push: Array) -> Array:
    return np.where(push > 0, 1.0, -1.0)


def _moved(search: Search, attack: Attacks, varied: Attacks, change: Array) -> Attacks:
    """Return an attack moved down the differences, by several step lengths.

    change: by which the margin changed, for each variation.
    """
    blocks, free = _blocks(search), np.flatnonzero(search.upper > search.lower)
    pushes = [attack.push[0]]
    if blocks:
        difference = np.array(
            [(varied.push[i] - attack.push[0])[block[0]] for i, block in enumerate(blocks)]
        )
        slope = change[: len(blocks)] / difference
        order = np.argsort(-np.abs(slope), kind="stable")
        for count, share in _PUSH_MOVES:
            push = attack.push[0].copy()
            for i in order[:count]:
                if slope[i]:
                    push[blocks[i]] += share * (-np.sign(slope[i]) - push[blocks[i]])
            pushes.append(np.clip(push, -1.0, 1.0))
    width, starts = search.upper - search.lower, [attack.start[0]]
    if len(free):
        down = np.zeros(4)
        for i, axis in enumerate(free):
            low, high = change[len(blocks) + 2 * i : len(blocks) + 2 * i + 2]
            down[axis] = np.sign(low - high)
        starts += [attack.start[0] + move * width * down for move in _START_MOVES]
    start = np.repeat(np.array(starts), len(pushes), axis=0)
    push = np.tile(np.array(pushes), (len(starts), 1))
    start = np.clip(start, search.lower, search.upper)
    return replace(attack.repeated(len(start)), start=start, push=push)

"""What an attack chooses for a whole run: the set of missing rays and the stretch that mirrors."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from verifier.attack import Mask
from verifier.raychoices import choices, masks
from verifier.search import Search

#: All choices are tried one by one if there are no more than so many.
MOST_CHOICES = 4096


@dataclass(frozen=True)
class FaultSets:
    """Some choices.

    gone: ``[count, rays]``, which rays are missing; mirror: ``[count]``, the index of the segment
    that mirrors, or -1.
    """

    gone: Mask
    mirror: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.mirror)

    def take(self, index: NDArray[np.intp]) -> FaultSets:
        """Return the choices at ``index``."""
        return FaultSets(self.gone[index], self.mirror[index])

    @staticmethod
    def join(one: FaultSets, other: FaultSets) -> FaultSets:
        """Return the choices of both."""
        return FaultSets(
            np.concatenate([one.gone, other.gone]), np.concatenate([one.mirror, other.mirror])
        )


def every_choice(search: Search) -> FaultSets:
    """Return all choices, the smallest sets of rays first.

    Where they are more than MOST_CHOICES: the largest part of them with fewer missing rays, but
    every segment and every single ray in any case.
    """
    rays, most, mirrors = search.problem.plant.lidar.rays, search.given.missing, search.mirrors
    room = MOST_CHOICES // len(mirrors)
    gone = masks(list(islice(choices(rays, most), max(room, 1 + rays))), rays)
    return FaultSets(np.repeat(gone, len(mirrors), axis=0), np.tile(mirrors, len(gone)))


def random_choices(search: Search, count: int) -> FaultSets:
    """Return choices, most of them with as many missing rays as there may be."""
    rays, most, random = search.problem.plant.lidar.rays, search.given.missing, search.random
    gone = np.zeros((count, rays), dtype=bool)
    if most:
        for mask in gone:
            size = most if random.random() < 0.75 else random.integers(most + 1)
            mask[random.choice(rays, size, replace=False)] = True
    return FaultSets(gone, random.choice(search.mirrors, count))


def neighbours(search: Search, gone: Mask, mirror: int) -> FaultSets:
    """Return the choices that differ in one ray (more, less or another one), or in the segment."""
    mine, theirs = np.flatnonzero(gone), np.flatnonzero(~gone)
    changed = []
    for off in [*mine, -1]:
        for on in [*theirs, -1] if search.given.missing else []:
            mask = gone.copy()
            if off >= 0:
                mask[off] = False
            if on >= 0:
                mask[on] = True
            if mask.sum() <= search.given.missing and (mask != gone).any():
                changed.append(mask)
    others = search.mirrors[search.mirrors != mirror]
    return FaultSets(
        np.concatenate(
            [np.array(changed, dtype=bool).reshape(-1, len(gone)), np.tile(gone, (len(others), 1))]
        ),
        np.concatenate([np.full(len(changed), mirror, dtype=np.intp), others]),
    )


def swapped(random: np.random.Generator, mask: Mask, other: Mask) -> Mask:
    """Return a mask with one of its rays replaced by one of another mask."""
    mask = mask.copy()
    mine, theirs = np.flatnonzero(mask & ~other), np.flatnonzero(other & ~mask)
    if mine.size and theirs.size:
        mask[random.choice(mine)] = False
        mask[random.choice(theirs)] = True
    return mask

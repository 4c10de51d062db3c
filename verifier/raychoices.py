"""Which sets of rays may be missing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray


def choices(rays: int, most: int) -> Iterator[tuple[int, ...]]:
    """Yield all sets of at most ``most`` of so many rays, the smallest first."""
    for count in range(most + 1):
        yield from combinations(range(rays), count)


def masks(sets: Sequence[tuple[int, ...]], rays: int) -> NDArray[np.bool_]:
    """Return sets of rays as masks, ``[sets, rays]``."""
    found = np.zeros((len(sets), rays), dtype=bool)
    for mask, some in zip(found, sets, strict=True):
        mask[list(some)] = True
    return found

"""Random numbers by index: each a function of a seed and of where it is used.

Nothing is drawn in order, so it does not matter how many runs are simulated side by side, in
which order, or by how many workers: run 17 at step 3 has the same noise on ray 5 always.

The function is a chain of SplitMix64 finalisers (Steele, Lea and Flood 2014), one per index.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.polygon import Array

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_SHIFTS = np.uint64(30), np.uint64(27), np.uint64(31)


def _mixed(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    x = x + _GOLDEN
    x = (x ^ (x >> _SHIFTS[0])) * _FIRST
    x = (x ^ (x >> _SHIFTS[1])) * _SECOND
    return x ^ (x >> _SHIFTS[2])


def hashed(seed: ArrayLike, *indices: ArrayLike) -> NDArray[np.uint64]:
    """Return 64 bits for a seed and indices (numbers from 0, of shapes that broadcast)."""
    value = _mixed(np.atleast_1d(np.asarray(seed, dtype=np.uint64)))
    for index in indices:
        value = _mixed(value ^ _mixed(np.atleast_1d(np.asarray(index, dtype=np.uint64))))
    return value


def uniforms(seed: ArrayLike, *indices: ArrayLike) -> Array:
    """Return numbers in [0, 1), multiples of 2^-53, for a seed and indices."""
    return np.asarray((hashed(seed, *indices) >> np.uint64(11)) * 2.0**-53, dtype=np.float64)

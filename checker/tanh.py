"""The hyperbolic tangent in doubles, its error proved.

Doubles, rounded to nearest: +, -, * and / err by a relative 2^-53. Values come from a table whose
entries Arb rounds, and from an addition formula; nothing rests on a mathematical library.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from flint import arb
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Absolute error of ``tanh``: the entry, a sum, a product, a sum and a quotient, of numbers of at
#: most about 1, err by 2^-53 each and no more; the series by less than 2^-60.
TANH_ERROR = 2.0**-50
_PARTS = 256  # entries of the table per unit
_END = 20  # 1 - tanh(20) < 2^-56


@cache
def _table() -> Array:
    return np.array([float((arb(j) / _PARTS).tanh().mid()) for j in range(_END * _PARTS + 1)])


def tanh(x: Array) -> Array:
    """Return tanh within TANH_ERROR.

    |x| = j / 256 + h with |h| <= 1/512, exactly (h is a difference of near numbers, j / 256 a
    double); tanh(h) = h - h^3/3 + 2 h^5/15 - ..., the next term below 2^-66; then
    (t + tanh h) / (1 + t tanh h).
    """
    size = np.minimum(np.abs(x), float(_END))
    j = np.rint(size * _PARTS)
    h = size - j / _PARTS
    square = h * h
    small = h * (1.0 + square * (-1 / 3 + square * (2 / 15)))
    t = _table()[np.where(np.isfinite(j), j, 0).astype(int)]
    return np.copysign((t + small) / (1.0 + t * small), x) + 0.0 * x

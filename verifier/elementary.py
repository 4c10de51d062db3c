"""exp, tanh, sin and cos at points, with proved error bounds.

No bound rests on the platform's mathematical library: all is +, -, *, / on doubles.
docs/soundness.md has the proofs of the constants.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from verifier.rounding import U

Array = NDArray[np.float64]

#: Relative error of tanh and 1 - tanh^2 as returned by ``tanh_pair``.
TANH_ERROR: Final = 64 * U
#: Absolute error of sin and cos as returned by ``sin_cos``, for |x| <= SIN_COS_RANGE.
SIN_COS_ERROR: Final = 16 * U
SIN_COS_RANGE: Final = 1000.0

_LN2_HIGH = float.fromhex("0x1.62e42fee00000p-1")  # the low 21 bits are 0
_LN2_LOW = float.fromhex("0x1.a39ef35793c76p-33")
_EXP = [1 / math.factorial(k) for k in range(15)]

_HALF_PI = (
    float.fromhex("0x1.921fb54400000p+0"),  # 33 bits
    float.fromhex("0x1.0b4611a600000p-34"),  # the next 33
    float.fromhex("0x1.3198a2e037073p-69"),
)
_SIN = [(-1) ** k / math.factorial(2 * k + 1) for k in range(10)]
_COS = [(-1) ** k / math.factorial(2 * k) for k in range(10)]


def _horner(coefficients: list[float], x: Array) -> Array:
    total = np.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total *= x
        total += coefficient
    return total


def exp_negative(x: Array) -> Array:
    """Return exp(x) for x <= 0 with a relative error below 16 U; 0 from -700 down.

    x = n ln 2 + r with |r| <= 0.35, Taylor's polynomial of degree 14 at r, times 2^n.
    """
    x = np.maximum(x, -700.0)
    n = np.rint(x * (1 / math.log(2)))
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    return np.ldexp(_horner(_EXP, r), n.astype(np.int32))


def tanh_pair(x: Array) -> tuple[Array, Array]:
    """Return tanh(x) and 1 - tanh(x)^2, each with a relative error below TANH_ERROR.

    Where exp(-2|x|) is near 1 the difference 1 - exp is taken from the series of expm1.
    """
    absolute = np.abs(x)
    e = exp_negative(-2 * absolute)
    below = np.where(absolute < 0.17, _one_minus_exp(2 * np.minimum(absolute, 0.17)), 1 - e)
    square = 1 + e
    return np.copysign(below / square, x), 4 * e / (square * square)


def _one_minus_exp(y: Array) -> Array:
    """Return 1 - exp(-y) for 0 <= y <= 0.34, relative error below 16 U."""
    return y * _horner([(-1) ** k / math.factorial(k + 1) for k in range(14)], y)


def sin_cos(x: Array) -> tuple[Array, Array]:
    """Return sin(x) and cos(x), absolute error below SIN_COS_ERROR for |x| <= SIN_COS_RANGE."""
    quarter = np.rint(x * (2 / math.pi))
    r = ((x - quarter * _HALF_PI[0]) - quarter * _HALF_PI[1]) - quarter * _HALF_PI[2]
    square = r * r
    sine, cosine = r * _horner(_SIN, square), _horner(_COS, square)
    turn = quarter.astype(np.int64) % 4
    swapped = (turn % 2).astype(bool)
    sine, cosine = np.where(swapped, cosine, sine), np.where(swapped, sine, cosine)
    return np.where(turn >= 2, -sine, sine), np.where((turn == 1) | (turn == 2), -cosine, cosine)

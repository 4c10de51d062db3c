"""exp, tanh, sin and cos at points, with proved error bounds.

No bound rests on the platform's mathematical library: all is +, -, *, / on doubles.
docs/soundness.md has the proofs of the constants. The functions take Values of a trace, or arrays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from verifier.compiled.trace import Value, maximum, minimum, power_of_two, rint, where
from verifier.models import lifted
from verifier.rounding import U

#: Relative error of tanh and 1 - tanh^2 as returned by ``tanh_pair``.
TANH_ERROR: Final = 64 * U
#: Absolute error of sin and cos as returned by ``sin_cos``, for |x| <= SIN_COS_RANGE.
SIN_COS_ERROR: Final = 16 * U
SIN_COS_RANGE: Final = 1000.0

_LN2_HIGH = float.fromhex("0x1.62e42fee00000p-1")  # the low 21 bits are 0
_LN2_LOW = float.fromhex("0x1.a39ef35793c76p-33")
_EXP = [1 / math.factorial(k) for k in range(15)]
_ONE_MINUS_EXP = [(-1) ** k / math.factorial(k + 1) for k in range(14)]

_HALF_PI = (
    float.fromhex("0x1.921fb54400000p+0"),  # 33 bits
    float.fromhex("0x1.0b4611a600000p-34"),  # the next 33
    float.fromhex("0x1.3198a2e037073p-69"),
)
_SIN = [(-1) ** k / math.factorial(2 * k + 1) for k in range(10)]
_COS = [(-1) ** k / math.factorial(2 * k) for k in range(10)]


def horner(coefficients: Sequence[Value | float], x: Value) -> Value:
    """Return the polynomial with these coefficients, of rising order, at x."""
    total = coefficients[-1] * x + coefficients[-2]
    for coefficient in reversed(coefficients[:-2]):
        total = total * x + coefficient
    return total


@lifted
def exp_negative(x: Value) -> Value:
    """Return exp(x) for x <= 0 with a relative error below 16 U; 0 or tiny from -700 down.

    x = n ln 2 + r with |r| <= 0.35, Taylor's polynomial of degree 14 at r, times 2^n.
    """
    x = maximum(x, -700.0)
    n = rint(x * (1 / math.log(2)))
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    return horner(_EXP, r) * power_of_two(n)


@lifted
def tanh_pair(x: Value) -> tuple[Value, Value]:
    """Return tanh(x) and 1 - tanh(x)^2, each with a relative error below TANH_ERROR.

    Where exp(-2|x|) is near 1 the difference 1 - exp is taken from the series of expm1.
    """
    absolute = abs(x)
    e = exp_negative(-2.0 * absolute)
    # 1 - exp(-y), 0 <= y <= 0.34, with a relative error below 16 U.
    y = 2.0 * minimum(absolute, 0.17)
    below = where(absolute < 0.17, y * horner(_ONE_MINUS_EXP, y), 1.0 - e)
    share = 1.0 / (1.0 + e)
    value = below * share
    return where(x < 0.0, -value, value), 4.0 * e * (share * share)


@lifted
def sin_cos(x: Value) -> tuple[Value, Value]:
    """Return sin(x) and cos(x), absolute error below SIN_COS_ERROR for |x| <= SIN_COS_RANGE."""
    quarter = rint(x * (2 / math.pi))
    r = ((x - quarter * _HALF_PI[0]) - quarter * _HALF_PI[1]) - quarter * _HALF_PI[2]
    square = r * r
    sine, cosine = r * horner(_SIN, square), horner(_COS, square)
    # Quarter turns beyond whole ones, exactly: -2, -1, 0, 1 or 2.
    turn = quarter - 4.0 * rint(quarter * 0.25)
    odd = abs(abs(turn) - 1.0) < 0.5
    sine, cosine = where(odd, cosine, sine), where(odd, sine, cosine)
    lower = (turn < -0.5) | (turn > 1.5)
    left = (turn < -1.5) | (turn > 0.5)
    return where(lower, -sine, sine), where(left, -cosine, cosine)

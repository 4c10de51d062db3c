"""Ball arithmetic on arrays of doubles: fast where Arb's balls, one by one, are slow.

A ball is a middle and a radius, and stands for all real numbers within. NumPy's +, -, *, / round
to nearest: the result m of one operation is within U |m| (and, if it underflows, 2^-1075) of the
exact one. Every radius is a sum of a few terms that are not negative; the factor UP and the term
TINY are more than rounding can take from it. What overflows becomes infinite or NaN, which
proves nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from flint import arb
from numpy.typing import NDArray

import checker.tanh

U = 2.0**-53
#: More than six roundings of a sum of terms that are not negative.
UP, DOWN = 1 + 2.0**-50, 1 - 2.0**-50
TINY = 2.0**-1000
#: Beyond, the hyperbolic tangent of a double is what it is here, within its error.
FAR = 100.0


class Balls(NamedTuple):
    """An array of balls: ``middle`` and ``radius`` (>= 0) of one shape."""

    middle: NDArray
    radius: NDArray

    def at(self, *index: Any) -> Balls:
        """Return a part of the array."""
        return Balls(self.middle[index], self.radius[index])


def exact(values: NDArray) -> Balls:
    """Return balls of radius 0."""
    return Balls(values, np.zeros_like(values))


def around(radius: NDArray) -> Balls:
    """Return balls around 0."""
    return Balls(np.zeros_like(radius), radius)


def from_arb(values: list[arb], shape: tuple[int, ...]) -> Balls:
    """Return the array of balls that contain given ones."""
    middle = np.array([float(x.mid()) for x in values]).reshape(shape)
    radius = np.array([float(x.rad()) for x in values]).reshape(shape)
    return Balls(middle, (radius + 2 * U * np.abs(middle)) * UP + TINY)


def to_arb(balls: Balls) -> list[arb]:
    """Return the balls of an array of one dimension."""
    pairs = zip(balls.middle.tolist(), balls.radius.tolist(), strict=True)
    return [arb(middle, radius) for middle, radius in pairs]


def between(low: NDArray, high: NDArray) -> Balls:
    """Return balls that contain [low, high]."""
    middle = low / 2 + high / 2
    return Balls(middle, np.maximum(high - middle, middle - low) * UP + TINY)


def raised(bound: NDArray) -> NDArray:
    """Return a bound after a few roundings of numbers that are not negative."""
    return bound * UP + TINY


def from_zero(bound: NDArray) -> Balls:
    """Return balls that contain [0, bound]."""
    return between(np.zeros_like(bound), bound)


def above(value: arb) -> float:
    """Return a double of at least a number's value, which is not negative."""
    return float(value.upper()) * UP


def lower(x: Balls) -> NDArray:
    """Return lower bounds: a unit in the last place further, as half of one may be rounded off."""
    low = x.middle - x.radius
    return low - (2 * U * np.abs(low) + TINY)


def upper(x: Balls) -> NDArray:
    """Return upper bounds."""
    high = x.middle + x.radius
    return high + (2 * U * np.abs(high) + TINY)


def size(x: Balls) -> NDArray:
    """Return upper bounds of the absolute values."""
    return (np.abs(x.middle) + x.radius) * UP


def _rounded(radius: NDArray, middle: NDArray) -> NDArray:
    """Return radii, changed in place, with what rounding the middle adds."""
    error = np.abs(middle)
    error *= U
    radius += error
    radius *= UP
    radius += TINY
    return radius


def add(x: Balls, y: Balls) -> Balls:
    """Return x + y."""
    middle = x.middle + y.middle
    return Balls(middle, _rounded(x.radius + y.radius, middle))


def subtract(x: Balls, y: Balls) -> Balls:
    """Return x - y."""
    return add(x, negative(y))


def multiply(x: Balls, y: Balls) -> Balls:
    """Return x y."""
    middle = x.middle * y.middle
    radius = x.radius * (np.abs(y.middle) + y.radius)
    radius += np.abs(x.middle) * y.radius
    return Balls(middle, _rounded(radius, middle))


def negative(x: Balls) -> Balls:
    """Return -x."""
    return Balls(-x.middle, x.radius)


def times(x: Balls, factor: float) -> Balls:
    """Return the multiple by a number."""
    middle = x.middle * factor
    return Balls(middle, (x.radius * abs(factor) + U * np.abs(middle)) * UP + TINY)


def over(x: Balls, number: float) -> Balls:
    """Return the quotient by a number of ordinary size."""
    middle = x.middle / number
    return Balls(middle, (x.radius / abs(number) + U * np.abs(middle)) * UP + TINY)


def reciprocal(x: Balls) -> Balls:
    """Return 1 / x; balls that may hold 0 have infinite radius."""
    low, high = lower(x), upper(x)
    one_sign = (low > 0) | (high < 0)
    ends = 1 / np.where(one_sign, high, 1.0), 1 / np.where(one_sign, low, 1.0)
    both = between(*ends)
    rounding = 2 * U * np.maximum(*map(np.abs, ends))
    return Balls(both.middle, np.where(one_sign, (both.radius + rounding) * UP + TINY, np.inf))


def product(matrix: NDArray, x: Balls) -> Balls:
    """Return matrix @ x, for matrices (..., rows, columns) of doubles and x (..., columns, k).

    A sum of n products in any order, fused or not, is off by at most n U / (1 - n U) times the
    sum of the absolute values, and by n 2^-1075 where products underflow.
    """
    n = matrix.shape[-1]
    share = (n + 2) * U * (1 + 2.0**-20)
    middle = matrix @ x.middle
    radius = np.abs(matrix) @ (x.radius + share * np.abs(x.middle))
    return Balls(middle, radius * (1 + 2 * share) + TINY)


def hull(x: Balls, y: Balls) -> Balls:
    """Return balls that contain both."""
    low = np.minimum(lower(x), lower(y))
    return between(low, np.maximum(upper(x), upper(y)))


def clip(x: Balls, low: float, high: float) -> Balls:
    """Return balls that contain what of x is in [low, high]; only what is there is meant."""
    return between(np.clip(lower(x), low, high), np.clip(upper(x), low, high))


def tanh(x: NDArray) -> Balls:
    """Return balls with the hyperbolic tangents of doubles."""
    middle = checker.tanh.tanh(np.clip(x, -FAR, FAR))
    return Balls(middle, np.where(np.isnan(middle), np.inf, checker.tanh.TANH_ERROR))


def tanh_between(x: Balls) -> Balls:
    """Return balls with the hyperbolic tangents of all that is in balls."""
    return hull(tanh(lower(x)), tanh(upper(x)))

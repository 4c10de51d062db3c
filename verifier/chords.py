"""Straight lines for functions of models that stray far: tanh, sigmoid, 1 / u.

Taylor's series is best where errors are small. Where they are not, g lies between two parallel
lines over the whole range [low, high] of its argument z:

    g(z) = slope z + middle,  up to half the distance of the lines

for any slope at all; a good one makes that distance small. It is a quarter to a half of what
Taylor's series of first order leaves, and the lines never leave the range of g by more than that.
"""

from __future__ import annotations

from verifier.arithmetic import Model, bounds, norm
from verifier.compiled.trace import Value, maximum, minimum, square_root, where
from verifier.elementary import tanh_pair
from verifier.functions import reciprocal, tanh
from verifier.models import lifted
from verifier.rounding import UP

#: Relative to all that is added up: covers the rounding of a line's few numbers, tanh_pair's too.
_ROUNDING = 2.0**-44


def tighter(a: Model, b: Model) -> Model:
    """Return whichever of two enclosures of the same has the smaller radius."""
    second = (b.radius < a.radius) | ~(a.radius >= 0.0)  # NaN
    c = [where(second, y, x) for x, y in zip(a.c, b.c, strict=True)]
    return Model(c, where(second, b.radius, a.radius))


def _line(z: Model, slope: Value, low: Value, high: Value, size: Value) -> Model:
    """Return slope z + [low, high]; size: of the numbers that those were computed from."""
    half = ((high - low) * 0.5 + _ROUNDING * size) * UP
    return z.times(slope).plus((low + high) * 0.5).widen(half)


@lifted
def tanh_line(z: Model) -> Model:
    """Enclose tanh by two lines with its slope at a place c >= 0.

    d(z) = tanh(z) - slope z is odd, convex below 0 and concave above, with its maximum there at
    c: it is at most d(c) above 0, and at most the larger of its end values below; and the other
    way about for its minimum.
    """
    low, high = bounds(z)
    at_low, _ = tanh_pair(low)
    at_high, _ = tanh_pair(high)
    c = _touching(low, high, at_low, at_high)
    at_c, slope = tanh_pair(c)
    first, last, top = at_low - slope * low, at_high - slope * high, at_c - slope * c
    most = maximum(first, where(high >= 0.0, top, last))
    least = minimum(last, where(low <= 0.0, -top, first))
    return _line(z, slope, least, most, 1.0 + abs(low) + abs(high) + c)


def _touching(low: Value, high: Value, at_low: Value, at_high: Value) -> Value:
    """Return a place c >= 0 near which tanh is as steep as its chord; any c is right."""
    width = high - low
    chord = (at_high - at_low) / where(width > 0.0, width, 1.0)
    square = minimum(maximum(1.0 - chord, 0.0), 1.0)
    # An approximation of atanh.
    above = 945.0 - square * (735.0 - 64.0 * square)
    below = 945.0 - square * (1050.0 - 225.0 * square)
    c = square_root(square) * above / below
    # On one side of 0 it is near the middle.
    middle, quarter = abs(low + high) * 0.5, width * 0.25
    inside = maximum(minimum(c, middle + quarter), middle - quarter)
    crosses = (low < 0.0) & (high > 0.0)
    return where(crosses, minimum(c, maximum(-low, high)), inside)


@lifted
def wide_tanh(z: Model) -> Model:
    """Enclose tanh: by its series or by lines, whichever is tighter."""
    return tighter(tanh(z), tanh_line(z))


@lifted
def wide_sigmoid(z: Model) -> Model:
    """Return 1 / (1 + exp(-z)) = (1 + tanh(z / 2)) / 2."""
    return wide_tanh(z.times(0.5)).times(0.5).plus(0.5)


def clipped_reciprocal(u: Model, reach: float) -> Model:
    """Return 1 / v for a number v of the model ``u`` that is known to be at least 1 / reach.

    The tightest of: the series; the lines of slope -1 / (a b) over the range [a, b] of v, one
    through the ends of the graph, the other its tangent; the range's, [1 / b, reach], of slope 0.
    """
    low, high = bounds(u)
    a = maximum(low, 1 / reach * (1 - 2.0**-50))
    b = maximum(high, a)
    over_a, over_b = 1.0 / a, 1.0 / b
    slope = over_a * over_b
    # 1 / v + slope v is convex, and nowhere below 2 sqrt(slope).
    most = maximum(over_a + slope * a, over_b + slope * b)
    least = 2.0 * square_root(slope)
    line = _line(u, -slope, least, most, most)
    middle, half = (over_a + over_b) * 0.5, (over_a - over_b) * 0.5 + _ROUNDING * over_a
    zero = 0.0 * norm(u)  # NaN of what is not finite
    flat = Model([middle + zero, *[zero] * (len(u.c) - 1)], (half + zero + 0.0 * u.radius) * UP)
    return tighter(tighter(reciprocal(u), line), flat)

"""Lines below and above tanh, sigmoid and ReLU on intervals, with rounding in their intercepts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from checker.tanh import tanh

Array = NDArray[np.float64]
#: Lower slope and intercept, upper slope and intercept.
Lines = tuple[Array, Array, Array, Array]


def _intercept(slope: Array, place: Array, low: Array, high: Array) -> Array:
    """Return b with tanh(x) <= slope x + b on [low, high], for slopes in [0, 1] and places >= 0.

    d(x) = tanh(x) - slope x is convex below 0, so that it is at most its larger end value there;
    above 0 tanh lies below its tangent at ``place``, whose difference from slope x is linear.
    A slope that is not the tangent's costs tightness only.
    """
    t = tanh(place)
    steep = 1.0 - t * t

    def tangent(x: Array) -> Array:
        return t + steep * (x - place) - slope * x

    def plain(x: Array) -> Array:
        return tanh(x) - slope * x

    below = np.maximum(plain(low), plain(np.minimum(high, 0.0)))
    above = np.maximum(tangent(np.maximum(low, 0.0)), tangent(high))
    most = np.where(low < 0.0, below, -np.inf)
    most = np.maximum(most, np.where(high > 0.0, above, -np.inf))
    most = np.where((low < 0.0) | (high > 0.0), most, plain(low))
    # t errs by 2^-50 and steep by thrice as much, times what it multiplies; sums by less.
    return most + 2.0**-46 * (1.0 + np.abs(low) + np.abs(high) + place)


def _tanh_above(low: Array, high: Array) -> tuple[Array, Array]:
    """Return slope and intercept of a line above tanh on [low, high].

    Where tanh is concave, the tangent in the middle; where it is convex, the chord; across 0 the
    tangent through the lower end, found by Newton's method, or the chord if that touches beyond
    the upper end. How well this is found matters to tightness only.
    """
    width = high - low
    at_low, at_high = tanh(low), tanh(high)
    # Between near ends the quotient is mostly rounding; there any slope is good.
    steady = np.where(width > 1e-6, width, 1.0)
    chord = np.where(width > 1e-6, (at_high - at_low) / steady, 1.0 - at_low * at_low)
    touch = np.clip(-low, 1e-3, None) * 0.5 + 0.3
    for _ in range(8):  # tanh(c) - tanh(low) = (1 - tanh(c)^2) (c - low)
        t = np.tanh(touch)
        steep = 1.0 - t * t
        f = t - at_low - steep * (touch - low)
        slope = 2.0 * t * steep * (touch - low)
        touch = np.clip(touch - f / np.maximum(slope, 1e-12), 1e-3, 20.0)
    concave = low >= 0.0
    place = np.where(concave, 0.5 * (low + high), np.minimum(touch, high))
    place = np.maximum(place, 0.0)
    t = tanh(place)
    tangent = concave | ((high > 0.0) & (touch < high))
    slope = np.clip(np.where(tangent, 1.0 - t * t, chord), 0.0, 1.0)
    return slope, _intercept(slope, place, low, high)


def tanh_lines(low: Array, high: Array) -> Lines:
    """Return lines below and above tanh on [low, high]; tanh is odd."""
    below, drop = _tanh_above(-high, -low)
    above, rise = _tanh_above(low, high)
    return below, -drop, above, rise


def sigmoid_lines(low: Array, high: Array) -> Lines:
    """Return lines below and above 1 / (1 + exp(-x)) = (1 + tanh(x / 2)) / 2."""
    below, drop, above, rise = tanh_lines(0.5 * low, 0.5 * high)
    # Halving is exact; the sum with 1 is rounded.
    return 0.25 * below, 0.5 + 0.5 * drop - 2.0**-50, 0.25 * above, 0.5 + 0.5 * rise + 2.0**-50


def relu_lines(low: Array, high: Array) -> Lines:
    """Return lines below and above max(x, 0): exact where the sign is known, else the chord."""
    mixed = (low < 0.0) & (high > 0.0)
    share = np.where(mixed, high / np.where(mixed, high - low, 1.0), np.where(low >= 0.0, 1.0, 0.0))
    share = np.clip(share, 0.0, 1.0)
    # Convex: the line through (high, high) with any slope up to 1 lies above at both ends if
    # its intercept does.
    rise = np.maximum((1.0 - share) * high, -share * low)
    rise = np.where(mixed, rise + 2.0**-50 * (np.abs(low) + high), 0.0)
    below = np.where(mixed, np.where(high > -low, 1.0, 0.0), share)
    return below, np.zeros_like(low), share, rise


def linear_lines(low: Array, high: Array) -> Lines:
    """Return the lines of no activation: the value itself."""
    one, zero = np.ones_like(low), np.zeros_like(low)
    return one, zero, one, zero

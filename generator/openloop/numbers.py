"""Numbers as VNN-LIB files state them: plain decimals, each exactly a float32 value.

A tool may read a number as a real, as a double or in the network's float32. Where the decimal is
a float32 value all of them take the same number, and a bound means one thing.
"""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction

import numpy as np


def nearest(value: Fraction | float) -> np.float32:
    """Return the float32 nearest to an exact number (ties to even, as IEEE 754 rounds)."""
    exact = Fraction(value)
    guess = np.float32(float(exact))
    if Fraction(float(guess)) == exact:
        return guess
    # Rounded by way of a double, a number may end at the wrong one of two neighbours.
    down, up = (np.nextafter(guess, np.float32(end)) for end in (-np.inf, np.inf))
    finite = [x for x in (guess, down, up) if np.isfinite(x)]
    return min(finite, key=lambda x: (abs(Fraction(float(x)) - exact), _odd(x)))


def at_least(value: Fraction | float) -> np.float32:
    """Return the least float32 that is not below an exact number."""
    rounded = nearest(value)
    if Fraction(float(rounded)) < Fraction(value):
        rounded = np.nextafter(rounded, np.float32(np.inf))
    return np.float32(rounded + np.float32(0))


def at_most(value: Fraction | float) -> np.float32:
    """Return the greatest float32 that is not above an exact number."""
    return np.float32(np.float32(0) - at_least(-Fraction(value)))


def plain(value: np.float32) -> str:
    """Return a float32 value as a decimal without an exponent, all of its digits.

    Raises ValueError for values that are not finite.
    """
    if not np.isfinite(value):
        raise ValueError(f"{value} has no decimal")
    text = format(Decimal(float(value) + 0.0), "f")
    return text if "." in text else f"{text}.0"


def _odd(value: np.float32) -> int:
    return int(np.float32(value).view(np.uint32) & 1)

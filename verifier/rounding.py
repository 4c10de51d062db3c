"""The rounding bounds that every enclosure rests on.

Arithmetic is IEEE binary64, round to nearest: each +, -, *, / and sqrt errs by a relative
U at most (no result that matters here underflows: TINY covers those that do). Radii are
sums and products of non-negative numbers; computing one with fewer than 2**10 operations
errs by less than a relative 2**-42, so multiplying by UP makes it an upper bound.
"""

from __future__ import annotations

U = 2.0**-53
UP = 1 + 2.0**-40
TINY = 2.0**-1000


def gamma(operations: int) -> float:
    """Return an upper bound of n U / (1 - n U), the relative error of n operations."""
    return operations * U * (1 + 2.0**-20)

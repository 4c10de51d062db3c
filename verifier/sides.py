"""The two sides of a guard: which part of a row, along which of its parameters, each needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from verifier.cuts import parts
from verifier.models import TERMS, Array, Models, cuttable, norm

#: Remainders of guards are taken this much larger, so that a checker whose own are a little
#: larger than ours agrees.
SLACK = 0.25
#: Covers the rounding of sums of a guard's coefficients, relative to their norm.
ROUNDING = 1e-14
#: Slack of the ends of an interval of a symbol: covers the rounding of its few operations.
_PAD = 1e-9


@dataclass(frozen=True)
class Sides:
    """Intervals ``[2, N]`` (lower, upper) within [-1, 1] of one parameter of each row.

    They contain all members of the row with the guard >= 0 and <= 0; empty where lower >
    upper. parameter: ``[N]``, 0 for x, 1 + j for error symbol j.
    """

    parameter: NDArray[np.intp]
    positive: Array
    negative: Array

    @property
    def larger(self) -> Array:
        """The width of the larger of the two (of 2)."""
        return np.maximum(_width(self.positive), _width(self.negative))

    @property
    def overlap(self) -> Array:
        """The width of what both contain; not below 0 by more than a gap's width."""
        return _width(self.positive) + _width(self.negative) - 2

    def take(self, index: NDArray) -> Sides:
        """Return the sides at ``index``."""
        return Sides(self.parameter[index], self.positive[:, index], self.negative[:, index])


def _width(interval: Array) -> Array:
    return np.maximum(interval[1] - interval[0], 0)


def sides(guards: Models, wide: bool) -> Sides:
    """Return the sides of guards ``[N]``; wide: along error symbols, too, if that is better."""
    guards = guards.widen(SLACK * guards.radius + ROUNDING * norm(guards.c))
    along_x = parts(guards)
    best = Sides(np.zeros(guards.radius.shape, dtype=np.intp), along_x.positive, along_x.negative)
    if not wide:
        return best
    for symbol in cuttable(guards.symbols):
        along = _along(guards, symbol)
        better = along.larger < best.larger
        best = Sides(
            np.where(better, along.parameter, best.parameter),
            np.where(better, along.positive, best.positive),
            np.where(better, along.negative, best.negative),
        )
    return best


def _along(guards: Models, symbol: int) -> Sides:
    """Return the sides along one symbol e: guards are m + (a + b x) e + the rest of them."""
    c = guards.c
    a, b = c[TERMS + 2 * symbol], np.abs(c[TERMS + 2 * symbol + 1])
    others = norm(c[1:]) - np.abs(a) - b + guards.radius
    # Where |a| <= b the sign of the symbol's coefficient is open, and nothing can be said.
    known = np.abs(a) > b
    least, most = np.where(known, np.abs(a) - b, 1.0), np.abs(a) + b

    def bound(middle: Array) -> Array:
        """Return the least value of sign(a) e at which the guard may be >= 0."""
        room = middle + others
        end = -room / np.where(room >= 0, least, np.where(known, most, 1.0))
        return np.where(known, end - _PAD * (1 + np.abs(end)), -1.0)

    rising = a > 0
    return Sides(
        np.full(a.shape, 1 + symbol),
        _interval(bound(c[0]), rising),
        _interval(bound(-c[0]), ~rising),
    )


def _interval(end: Array, upwards: NDArray[np.bool_]) -> Array:
    """Return [end, 1] where it goes upwards, else [-1, -end]; empty where end > 1."""
    inside = np.maximum(end, -1.0)
    interval = np.where(upwards, (inside, np.ones_like(end)), (-np.ones_like(end), -inside))
    return np.where(end > 1, np.array([[1.0], [-1.0]]), interval)

"""Where on a row a guard can have either sign: how to cut the row.

A guard is G(x, e) with |G - p(x)| <= r. The part where G may be >= 0 is within
{p >= -r}, the part where it may be <= 0 within {p <= r}. Both are returned as intervals;
together they cover the row, and they overlap where the sign is open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from verifier.models import TERMS, Array, Models, error_spread, norm
from verifier.rounding import UP, gamma

_CELLS = 128


@dataclass(frozen=True)
class Parts:
    """Intervals ``[2, N]`` (lower, upper) within [-1, 1]; empty where lower > upper."""

    positive: Array
    negative: Array


def parts(guards: Models) -> Parts:
    """Return the parts of each row on which guards ``[N]`` may be >= 0 and <= 0."""
    p = guards.c[:TERMS]
    # Evaluating p by Horner's rule on [-1, 1] errs by less than this.
    rest = (error_spread(guards) + gamma(4 * TERMS) * norm(p)) * UP
    return Parts(_above(p, rest), _above(-p, rest))


def _above(p: Array, rest: Array) -> Array:
    """Return an interval that contains every x in [-1, 1] with p(x) >= -rest."""
    count = p.shape[1]
    result = np.empty((2, count))
    powers = np.arange(1, TERMS)[:, None]
    swing = (powers[1:] * np.abs(p[2:])).sum(axis=0) * UP
    monotone = np.abs(p[1]) > swing
    low, high = _cell_hull(p, rest)
    result[0], result[1] = low, high
    if monotone.any():
        q, r = p[:, monotone], rest[monotone]
        least_slope = np.abs(q[1]) - swing[monotone]
        root = _root(q)
        # Beyond the root by this much, p + rest is negative: checked below, not trusted.
        pad = 2 * r / least_slope + 1e-13
        rising = q[1] > 0
        bound = np.where(rising, root - pad, root + pad)
        surely = _value(q, np.clip(bound, -1, 1)) + r < 0
        bound = np.where(surely, np.clip(bound, -1, 1), np.where(rising, -1.0, 1.0))
        end = np.where(rising, 1.0, -1.0)
        empty = _value(q, end) + r < 0
        lower, upper = np.where(rising, bound, -1.0), np.where(rising, 1.0, bound)
        result[0, monotone] = np.where(empty, 1.0, lower)
        result[1, monotone] = np.where(empty, -1.0, upper)
    return result


def _value(p: Array, x: Array) -> Array:
    total = p[-1] + 0 * x
    for coefficient in p[-2::-1]:
        total = total * x + coefficient
    return total


def _root(p: Array) -> Array:
    """Return a root of p, monotone on [-1, 1], or the end nearest to one; no promise."""
    low, high = np.full(p.shape[1], -1.0), np.ones(p.shape[1])
    rising = p[1] > 0
    for _ in range(50):
        middle = (low + high) / 2
        below = (_value(p, middle) < 0) == rising
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2


def _cell_hull(p: Array, rest: Array) -> tuple[Array, Array]:
    """Return the hull of the cells of a grid on which p + rest may be >= 0."""
    half = 1 / _CELLS
    middle = -1 + half * (2 * np.arange(_CELLS)[:, None] + 1)
    powers = np.arange(1, TERMS)[:, None]
    steep = (powers * np.abs(p[1:])).sum(axis=0) * UP
    most = _value(p[:, None, :], np.asarray(middle, dtype=float)) + (rest + half * steep) * UP
    possible = ~(most < 0)  # NaN, from overflow, is possible too
    some = possible.any(axis=0)
    first = possible.argmax(axis=0)
    last = _CELLS - 1 - possible[::-1].argmax(axis=0)
    low = np.where(some, -1 + 2 * half * first, 1.0)
    high = np.where(some, -1 + 2 * half * (last + 1), -1.0)
    return low, high

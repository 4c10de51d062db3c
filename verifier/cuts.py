"""Where on a row a guard can have either sign: how to cut the row.

A guard is G(x, e) with |G - p(x)| <= r. The part where G may be >= 0 is within
{p >= -r}, the part where it may be <= 0 within {p <= r}. Both are returned as intervals;
together they cover the row, and they overlap where the sign is open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from verifier.arithmetic import Model, error_spread, total_size
from verifier.compiled.trace import Value, maximum, minimum, where
from verifier.compiled.trace import total as summed
from verifier.elementary import horner
from verifier.models import TERMS, Array, Models, apply
from verifier.rounding import UP, gamma

_CELLS = 128
#: Steps of bisection, and of Newton's method after them, towards a root.
_BISECTIONS = 26
_NEWTON = 2


@dataclass(frozen=True)
class Parts:
    """Intervals ``[2, N]`` (lower, upper) within [-1, 1]; empty where lower > upper."""

    positive: Array
    negative: Array


def parts(guards: Models) -> Parts:
    """Return the parts of each row on which guards ``[N]`` may be >= 0 and <= 0."""
    found = np.array(apply(_monotone_parts, guards))
    positive, negative, rest = found[1:3], found[3:5], found[5]
    others = np.flatnonzero(~(found[0] > 0))
    if others.size:
        p = guards.c[:TERMS, others]
        positive[:, others] = _cell_hull(p, rest[others])
        negative[:, others] = _cell_hull(-p, rest[others])
    return Parts(positive, negative)


def _monotone_parts(guard: Model) -> tuple[Value, ...]:
    """Return whether p surely rises or falls on [-1, 1], then both parts, and r."""
    p = guard.p
    # Evaluating p by Horner's rule on [-1, 1] errs by less than this.
    rest = (error_spread(guard) + gamma(4 * TERMS) * total_size(p)) * UP
    swing = summed([k * abs(p[k]) for k in range(2, TERMS)]) * UP
    rising, slope = p[1] > 0.0, abs(p[1]) - swing
    root = _root(p, rising)
    # Beyond the root by this much, p + rest is negative: checked below, not trusted.
    pad = 2.0 * rest / slope + 1e-13
    before, after = (maximum(minimum(x, 1.0), -1.0) for x in (root - pad, root + pad))
    first, second = horner(p, before), horner(p, after)
    at_low, at_high = horner(p, p[0].trace.number(-1.0)), horner(p, p[0].trace.number(1.0))
    intervals = []
    for sign, up in ((1.0, rising), (-1.0, ~rising)):
        # Where sign x p rises, what is wanted lies above x = lower, else below x = upper.
        lower = where(up & (sign * first + rest < 0.0), before, -1.0)
        upper = where(~up & (sign * second + rest < 0.0), after, 1.0)
        empty = sign * where(up, at_high, at_low) + rest < 0.0
        intervals += [where(empty, 1.0, lower), where(empty, -1.0, upper)]
    return (where(abs(p[1]) > swing, 1.0, 0.0), *intervals, rest)


def _root(p: list[Value], rising: Value) -> Value:
    """Return a root of p, monotone on [-1, 1], or the end nearest to one; no promise."""
    number = p[0].trace.number
    low, high = number(-1.0), number(1.0)
    for _ in range(_BISECTIONS):
        middle = (low + high) * 0.5
        value = horner(p, middle)
        below = where(rising, value, -value) < 0.0
        low, high = where(below, middle, low), where(below, high, middle)
    x = (low + high) * 0.5
    slopes = [k * p[k] for k in range(1, TERMS)]
    for _ in range(_NEWTON):
        x = maximum(minimum(x - horner(p, x) / horner(slopes, x), high), low)
    return x


def _cell_hull(p: Array, rest: Array) -> Array:
    """Return the hulls ``[2, N]`` of the cells of a grid on which p + rest may be >= 0."""
    half = 1 / _CELLS
    middle = -1 + half * (2 * np.arange(_CELLS)[:, None] + 1)
    powers = np.arange(1, TERMS)[:, None]
    steep = (powers * np.abs(p[1:])).sum(axis=0) * UP
    value = np.zeros((_CELLS, p.shape[1]))
    for coefficient in p[::-1]:
        value = value * middle + coefficient
    most = value + (rest + half * steep) * UP
    possible = ~(most < 0)  # NaN, from overflow, is possible too
    some = possible.any(axis=0)
    first = possible.argmax(axis=0)
    last = _CELLS - 1 - possible[::-1].argmax(axis=0)
    low = np.where(some, -1 + 2 * half * first, 1.0)
    high = np.where(some, -1 + 2 * half * (last + 1), -1.0)
    return np.array([low, high])

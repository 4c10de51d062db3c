"""Sets of scans: what noise and missing rays can make of one."""

from __future__ import annotations

from collections.abc import Collection
from fractions import Fraction
from itertools import combinations

from generator.openloop.spec import Box
from generator.openloop.views import UNIT, Units, View

#: Of all rays that are neither missing nor free: 1/128 m, about 8 mm, in multiples of UNIT.
BASE_NOISE = 8


def hull(view: View) -> Box:
    """Return the box around the scans that are met from all over the start range.

    A reading that is the same from everywhere is given one UNIT either way.
    """
    same = view.lowest == view.highest
    lower, upper = view.lowest - same, view.highest + same
    return _box(view, lower, upper, Fraction(0))


def noisy(view: View, noise: Fraction) -> Box:
    """Return the box of readings off by up to ``noise`` m, clipped as the LiDAR clips them."""
    return _box(view, view.scan, view.scan, noise)


def too_far(view: View, rays: Collection[int]) -> Box:
    """Return the box in which the given rays read anything from their distance to the range.

    A missing ray reads the range. All rays have the base noise.
    """
    upper = view.scan + BASE_NOISE
    upper[list(rays)] = view.reach
    return _box(view, view.scan - BASE_NOISE, upper, Fraction(0))


def free(view: View, rays: Collection[int]) -> Box:
    """Return the box in which the given rays read anything; the others have the base noise."""
    lower, upper = view.scan - BASE_NOISE, view.scan + BASE_NOISE
    lower[list(rays)], upper[list(rays)] = 0, view.reach
    return _box(view, lower, upper, Fraction(0))


def subsets(rays: int, count: int) -> list[tuple[int, ...]]:
    """Return all sets of so many rays."""
    return list(combinations(range(rays), count))


def windows(rays: int, count: int) -> list[tuple[int, ...]]:
    """Return all sets of so many adjacent rays."""
    return [tuple(range(i, i + count)) for i in range(rays - count + 1)]


def _box(view: View, lower: Units, upper: Units, noise: Fraction) -> Box:
    """Return the box of float32 scans (m) inside bounds in UNITs that noise (m) widens."""
    return Box.inside(
        [max(x * UNIT - noise, Fraction(0)) for x in lower.tolist()],
        [min(x * UNIT + noise, view.reach * UNIT) for x in upper.tolist()],
    )

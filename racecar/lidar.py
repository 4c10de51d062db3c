"""The LiDAR: the distance along each ray to the first wall, clipped at the range.

A ray is cast in *inverse distance* u = 1 / t, where it needs no trigonometry per ray and
no case for rays parallel to a wall. Constraint ``a . p <= b`` of a wall, missed by
``g = a . p - b`` where the car is, changes along the ray as ``g - h t``. A point at
distance t lies inside the constraint

    if the car is outside it (g > 0):   when  u <= h / g
    if the car is inside it (g <= 0):   when  u >= h / g

so a ray hits the wall first at ``u = min h/g`` over the constraints that the car is outside
of, and hits it at all if that is positive and at least ``max h/g`` over the others.
``h / g`` is linear in (cos, sin) of the ray's relative angle: a product of small matrices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from racecar.errors import BadInput
from racecar.polygon import Array, Polygon

_HUGE = 1e30  # beyond every inverse distance that matters
_TINY = 1e-200


@dataclass(frozen=True)
class Lidar:
    """A planar scanner.

    rays: how many, equally spaced over the field of view, the first at its right end;
    field_of_view: radians, centred on the heading; range: metres, where readings are
    clipped (a missing ray reads this).
    """

    rays: int = 21
    field_of_view: float = math.radians(230)
    range: float = 5.0

    def __post_init__(self) -> None:
        if self.rays < 2:
            raise BadInput(f"lidar: {self.rays} rays; at least 2 are needed")
        if not 0 < self.field_of_view <= 2 * math.pi:
            raise BadInput(
                f"lidar: field of view is {self.field_of_view} rad; it must be in (0, 2 pi]"
            )
        if not (math.isfinite(self.range) and self.range > 0):
            raise BadInput(f"lidar: range is {self.range} m; it must be positive")

    @cached_property
    def angles(self) -> Array:
        """Ray angles relative to the heading, ``[rays]``, radians, right to left."""
        return np.linspace(-self.field_of_view / 2, self.field_of_view / 2, self.rays)

    @cached_property
    def _directions(self) -> Array:
        return np.column_stack([np.cos(self.angles), np.sin(self.angles)])

    def scan(
        self, obstacles: Sequence[Polygon], s: ArrayLike, f: ArrayLike, theta: ArrayLike
    ) -> Array:
        """Return distances ``[batch, rays]`` in metres for states ``[batch]`` (m, m, rad).

        A car inside an obstacle reads 0 on every ray.
        """
        s, f, theta = (np.atleast_1d(np.asarray(x, dtype=float)) for x in (s, f, theta))
        return self.scan_rows(obstacles, s, f, theta).T

    def scan_rows(self, obstacles: Sequence[Polygon], s: Array, f: Array, theta: Array) -> Array:
        """Return the same scan with one row per ray, ``[rays, batch]`` (contiguous)."""
        lower, upper = np.array([s.min(), f.min()]), np.array([s.max(), f.max()])
        cosine, sine = np.cos(theta), np.sin(theta)
        nearest = np.full((self.rays, s.size), 1 / self.range)
        inside = np.zeros(s.shape, dtype=bool)
        for obstacle in obstacles:
            near = obstacle.relevant(lower, upper, self.range)
            if near is None:
                continue
            inverse, within = self._first_hit(near, s, f, cosine, sine)
            np.maximum(nearest, inverse, out=nearest)
            if within is not None:
                inside |= within
        np.reciprocal(nearest, out=nearest)
        if inside.any():
            nearest[:, inside] = 0.0
        return nearest

    def _first_hit(
        self, obstacle: Polygon, s: Array, f: Array, cosine: Array, sine: Array
    ) -> tuple[Array, Array | None]:
        """Return inverse distances ``[rays, batch]`` (at most 0: no hit) and who is inside."""
        first: Array | None = None  # min over the constraints that the car is outside of
        last: Array | None = None  # max over the constraints that it is inside of
        all_inside = np.ones(s.shape, dtype=bool)
        for (a_s, a_f), b in zip(obstacle.normals, obstacle.offsets, strict=True):
            miss = a_s * s + a_f * f - b
            outside = miss > 0
            all_inside &= ~outside
            scale = 1 / np.where(outside, miss, np.minimum(miss, -_TINY))
            ahead, across = (a_s * sine + a_f * cosine) * scale, (a_s * cosine - a_f * sine) * scale
            ratio = self._combine(ahead, across)
            if outside.all():
                first = ratio if first is None else np.minimum(first, ratio, out=first)
            elif not outside.any():
                last = ratio if last is None else np.maximum(last, ratio, out=last)
            else:
                entry, leave = np.where(outside, ratio, _HUGE), np.where(outside, -_HUGE, ratio)
                first = entry if first is None else np.minimum(first, entry, out=first)
                last = leave if last is None else np.maximum(last, leave, out=last)
        if first is None:
            return np.zeros((self.rays, s.size)), np.ones(s.shape, dtype=bool)
        if last is not None:
            np.multiply(first, first >= last, out=first)
        return first, all_inside if all_inside.any() else None

    def _combine(self, ahead: Array, across: Array) -> Array:
        """Return ``cos(angle) ahead + sin(angle) across`` for every ray: ``[rays, batch]``."""
        return self._directions @ np.stack([ahead, across])

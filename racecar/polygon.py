"""Convex polygons in the (s, f) plane, the shape of every wall and unsafe set.

A polygon is an intersection of half-planes and may be unbounded. Constraint j reads
``normals[j] @ (s, f) <= offsets[j]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.errors import BadInput

Array = NDArray[np.float64]

#: With fewer points than this, one call on all constraints is the fastest.
_FEW = 64


@dataclass(frozen=True, eq=False)
class Polygon:
    """A convex set ``{p : normals @ p <= offsets}``, p = (s, f) in metres.

    normals: ``[k, 2]``, unit vectors for walls; offsets: ``[k]``, metres.
    """

    normals: Array
    offsets: Array

    @classmethod
    def from_constraints(cls, constraints: ArrayLike) -> Polygon:
        """Build from rows ``[a_s, a_f, b]``, each meaning ``a_s s + a_f f <= b``."""
        rows = np.asarray(constraints, dtype=float).reshape(-1, 3)
        return cls(normals=rows[:, :2].copy(), offsets=rows[:, 2].copy())

    @classmethod
    def from_box(cls, lower: tuple[float, float], upper: tuple[float, float]) -> Polygon:
        """Build an axis-aligned box; infinite bounds leave that side open."""
        rows = []
        for axis, unit in enumerate(((1.0, 0.0), (0.0, 1.0))):
            if np.isfinite(lower[axis]):
                rows.append([-unit[0], -unit[1], -lower[axis]])
            if np.isfinite(upper[axis]):
                rows.append([unit[0], unit[1], upper[axis]])
        return cls.from_constraints(rows)

    def to_constraints(self) -> list[list[float]]:
        """Return the rows ``[a_s, a_f, b]`` (no negative zeros)."""
        rows = np.column_stack([self.normals, self.offsets]) + 0.0
        return [[float(x) for x in row] for row in rows]

    def misses(self, s: ArrayLike, f: ArrayLike) -> Array:
        """Return by how much each constraint is missed: ``[k, ...]``, positive outside."""
        s, f = np.broadcast_arrays(np.asarray(s, dtype=float), np.asarray(f, dtype=float))
        misses = self.normals @ pair(s.ravel(), f.ravel())
        misses -= self.offsets[:, None]
        return misses.reshape(-1, *s.shape)

    def separation(self, s: ArrayLike, f: ArrayLike) -> Array:
        """Return the largest miss: positive outside, at most 0 inside.

        For a box with unit normals this is the distance in the maximum norm.
        """
        return np.max(self.misses(s, f), axis=0)

    def relevant(self, lower: Array, upper: Array, reach: float) -> Polygon | None:
        """Drop what cannot matter within ``reach`` metres of the box [lower, upper].

        Returns None if the polygon lies farther away than ``reach`` from every point of
        the box; otherwise the polygon less the constraints that hold everywhere there.
        """
        positive, negative = np.maximum(self.normals, 0), np.minimum(self.normals, 0)
        slack = reach * np.linalg.norm(self.normals, axis=1)
        least = positive @ lower + negative @ upper - self.offsets - slack
        most = positive @ upper + negative @ lower - self.offsets + slack
        if np.any(least > 0):
            return None
        keep = most > 0
        return Polygon(self.normals[keep], self.offsets[keep])


@dataclass(frozen=True, eq=False)
class Stack:
    """The constraints of several polygons in one list, for work on all of them at once.

    normals: ``[m, 2]``; offsets: ``[m]``; owner: ``[m]``, increasing, whose constraint each
    one is.
    """

    normals: Array
    offsets: Array
    owner: NDArray[np.intp]

    @cached_property
    def norms(self) -> Array:
        """The lengths of the normals, ``[m]``."""
        return np.sqrt(np.sum(self.normals**2, axis=1))

    @cached_property
    def starts(self) -> NDArray[np.intp]:
        """Where the constraints of each polygon begin, ``[k]``."""
        begins = np.ones(len(self.owner), dtype=bool)
        np.not_equal(self.owner[1:], self.owner[:-1], out=begins[1:])
        return np.flatnonzero(begins)

    @cached_property
    def _corners(self) -> Array:
        positive, negative = np.maximum(self.normals, 0), np.minimum(self.normals, 0)
        return np.block([[positive, negative], [negative, positive]])

    @cached_property
    def _limits(self) -> Array:
        return np.tile(self.offsets, 2)

    @cached_property
    def _slopes(self) -> Array:
        return np.concatenate([self.norms, -self.norms])

    def misses(self, points: Array) -> Array:
        """Return by how much each constraint is missed, ``[m, batch]``; points: ``[2, batch]``."""
        misses = self.normals @ points
        misses -= self.offsets[:, None]
        return misses

    def largest(self, misses: Array) -> Array:
        """Return the largest value of each polygon's constraints: ``[k, ...]`` from ``[m, ...]``.

        Of misses that is the separation from each polygon.
        """
        if len(self.starts) == len(self.owner):
            return misses
        if misses.ndim == 1 or misses.shape[1] < _FEW:
            return np.maximum.reduceat(misses, self.starts, axis=0)
        parts = np.split(misses, self.starts[1:])  # reduceat is slow along rows
        return np.array([np.maximum.reduce(part, axis=0) for part in parts])

    def bounds(self, box: Array, reach: float = 0.0) -> tuple[Array, Array]:
        """Return the least and the largest miss of each constraint near a box, ``[m]`` each.

        box: least s, least f, largest s, largest f; reach: how far points may lie outside it.
        """
        bounds = self._corners @ box
        bounds -= self._limits
        if reach:
            bounds -= reach * self._slopes
        return bounds[: len(self.offsets)], bounds[len(self.offsets) :]

    def take(self, kept: NDArray[np.bool_]) -> Stack:
        """Return the constraints where ``kept`` (``[m]``) is true."""
        return Stack(self.normals[kept], self.offsets[kept], self.owner[kept])


def stacked(polygons: Sequence[Polygon]) -> Stack:
    """Stack polygons; the answer for the same polygons is kept."""
    return _stacked(tuple(polygons))


@lru_cache(maxsize=1024)
def _stacked(polygons: tuple[Polygon, ...]) -> Stack:
    counts = [len(polygon.offsets) for polygon in polygons]
    if not counts or min(counts) == 0:
        raise BadInput("polygons: give at least one, and at least one constraint in each")
    return Stack(
        np.concatenate([polygon.normals for polygon in polygons]),
        np.concatenate([polygon.offsets for polygon in polygons]),
        np.repeat(np.arange(len(polygons)), counts),
    )


def pair(s: Array, f: Array) -> Array:
    """Return points ``[2, batch]`` (like np.stack, but several times as fast)."""
    points = np.empty((2, len(s)))
    points[0], points[1] = s, f
    return points


def bounding_box(points: Array) -> Array:
    """Return the least s, least f, largest s and largest f of points ``[2, batch]``."""
    return np.concatenate([points.min(axis=1), points.max(axis=1)])

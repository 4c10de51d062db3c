"""Convex polygons in the (s, f) plane, the shape of every wall and unsafe set.

A polygon is an intersection of half-planes and may be unbounded. Constraint j reads
``normals[j] @ (s, f) <= offsets[j]``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


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
        s, f = np.asarray(s, dtype=float), np.asarray(f, dtype=float)
        shape = (-1,) + (1,) * s.ndim
        a_s, a_f = self.normals[:, 0].reshape(shape), self.normals[:, 1].reshape(shape)
        return a_s * s + a_f * f - self.offsets.reshape(shape)

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

"""Everything about the walls that depends on the row but not on the ray.

Seen from the car, constraint j of a wall is missed by g_j (racecar.polygon), and a ray
enters it at the rate h_j = cos(angle) A_j + sin(angle) B_j (racecar.lidar). So a ray meets
face j at inverse distance u_j = h_j / g_j, provided that the wall's other constraints k hold
there: X_jk = h_k g_j - h_j g_k >= 0, a cross product. Each of h, u and X is a pair of models
per row, to be combined with the cosine and sine of a ray's angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from racecar.polygon import Polygon
from verifier.functions import reciprocal, sine_cosine
from verifier.models import Array, Models, bounds, stack
from verifier.rows import THETA, F, S

Index = NDArray[np.intp]

#: A face that the car may be nearer to than this (metres) is not divided by.
NEAREST = 0.02


@dataclass(frozen=True)
class Face:
    """One constraint of one obstacle: their places in the frame's lists, and its numbers."""

    polygon: int
    place: int
    normal: tuple[float, float]
    offset: float


def faces_within(obstacles: Sequence[Polygon], state: Models, reach: float) -> list[Face]:
    """Return the faces that matter within ``reach`` metres of any member of any row."""
    low, high = bounds(state[S : F + 1])
    lower, upper = low.min(axis=1), high.max(axis=1)
    # A millimetre more covers the rounding of the test itself.
    reach = reach + 1e-3 + 2.0**-48 * float(np.abs([lower, upper]).max())
    faces = []
    for p, polygon in enumerate(obstacles):
        near = polygon.relevant(lower, upper, reach)
        if near is None:
            continue
        if not len(near.offsets):
            near = polygon  # deep inside: no face is near, but the wall is
        for normal, offset in zip(near.normals, near.offsets, strict=True):
            same = np.all(polygon.normals == normal, axis=1) & (polygon.offsets == offset)
            faces.append(_face(p, polygon, int(np.flatnonzero(same)[0])))
    if not faces:  # one, out of reach, keeps the arrays from being empty
        first = obstacles[0]
        positive, negative = np.maximum(first.normals, 0), np.minimum(first.normals, 0)
        least = positive @ lower + negative @ upper - first.offsets
        faces.append(_face(0, first, int(least.argmax())))
    return faces


def _face(index: int, polygon: Polygon, place: int) -> Face:
    a_s, a_f = polygon.normals[place]
    return Face(index, place, (float(a_s), float(a_f)), float(polygon.offsets[place]))


class Walls:
    """The pairs of models of all faces; rows are the last axis throughout.

    low, high: ``[faces, rows]`` bounds of g; usable: where g surely exceeds NEAREST; pairs:
    the pairs (j, k), j < k, of faces of one wall.
    """

    def __init__(self, faces: list[Face], state: Models) -> None:
        self.faces = faces
        sine, cosine = sine_cosine(state[THETA])
        miss, ahead, across = [], [], []
        for face in faces:
            a_s, a_f = face.normal
            position = state[S].times(a_s) + state[F].times(a_f)
            miss.append(position.plus(-face.offset))
            ahead.append(sine.times(a_s) + cosine.times(a_f))
            across.append(cosine.times(a_s) - sine.times(a_f))
        misses = stack(miss)
        self.low, self.high = bounds(misses)
        self.usable = self.low > NEAREST
        one = np.zeros_like(misses.c)
        one[0] = 1.0
        inverse = reciprocal(
            Models(np.where(self.usable, misses.c, one), np.where(self.usable, misses.radius, 0.0))
        )
        rates = stack([stack(ahead), stack(across)])  # [2, faces, rows]
        self._rates = rates
        self._ratios = rates * inverse[None]
        self.pairs = [
            (j, k)
            for j, a in enumerate(faces)
            for k, b in enumerate(faces)
            if j < k and a.polygon == b.polygon
        ]
        first, second = np.array(self.pairs, dtype=np.intp).reshape(-1, 2).T
        self._crosses = (
            rates[:, second] * misses[None, first] - rates[:, first] * misses[None, second]
        )
        self.miss_centre = misses.c[0]

    def rate(self, face: Index, row: Index) -> Models:
        """Return the pairs of h: ``[2, N]`` for faces and rows ``[N]``."""
        return self._rates[:, face, row]

    def ratio(self, face: Index, row: Index) -> Models:
        """Return the pairs of u, where usable: ``[2, N]``."""
        return self._ratios[:, face, row]

    def cross(self, pair: Index, row: Index) -> Models:
        """Return the pairs of X_jk with (j, k) = pairs[pair]: ``[2, N]``."""
        return self._crosses[:, pair, row]

    def centres(self, cosine: Array, sine: Array) -> tuple[Array, Array, Array]:
        """Return h, u ``[faces, rays, rows]`` and X ``[pairs, rays, rows]`` at x = 0.

        They guide the search and prove nothing. u is -inf where the face is not usable.
        """

        def combine(pair: Models) -> Array:
            a, b = pair.c[0]
            return cosine[:, None] * a[:, None, :] + sine[:, None] * b[:, None, :]

        ratio = np.where(self.usable[:, None, :], combine(self._ratios), -np.inf)
        return combine(self._rates), ratio, combine(self._crosses)

"""The LiDAR on Taylor models: a proved enclosure of each ray's reading.

A car at distance g outside the line of an obstacle's face, a ray that closes in on it at the
rate h per metre: the ray crosses the line at inverse distance u = h / g. A ray hits a convex
obstacle at the least u of the faces that the car is outside of, if all other faces' constraints
hold there: X_jk = h_k g_j - h_j g_k >= 0. The reading is 1 / max(1 / range, all u that are hit).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce, wraps
from typing import Any

from flint import arb, arb_mat

from checker import models
from checker.balls import from_arb
from checker.files import require
from checker.models import Model, add, bound, multiply, plus, scale, subtract

#: Signs that a row assumes: (ray, obstacle, front face j, back face k) -> whether X_jk >= 0.
Assumed = dict[tuple[int, ...], bool]
#: A quantity along a ray: cos(angle) p + sin(angle) q, with models p and q.
Pair = tuple[Model, Model]
#: A face: obstacle and place.
Face = tuple[int, int]

#: Faces nearer than this (m) are not divided by.
NEAREST = arb("0.02")


class Rays:
    """The ray directions: exactly -fov/2 + i fov/(n - 1), fov the instance's double."""

    def __init__(self, lidar: dict[str, Any]) -> None:
        self.count, self.reach = int(lidar["rays"]), arb(lidar["range"])
        fov = arb(lidar["field_of_view"])
        angles = [fov * i / (self.count - 1) - fov / 2 for i in range(self.count)]
        self.directions = arb_mat([[a.cos(), a.sin()] for a in angles])
        self.directions_in_doubles = from_arb(self.directions.entries(), (self.count, 2))


def _once(method: Callable[..., Any]) -> Callable[..., Any]:
    """Make a method of View remember what it returned."""

    @wraps(method)
    def known(self: View, *arguments: Any) -> Any:
        key = (method.__name__, *arguments)
        if key not in self.known:
            self.known[key] = method(self, *arguments)
        return self.known[key]

    return known


class View:
    """What the cars of a row see of a frame's obstacles, if the row assumes some signs."""

    def __init__(
        self, rays: Rays, obstacles: list[list[list[float]]], state: list[Model], assumed: Assumed
    ) -> None:
        self._rays, self._obstacles, self._assumed = rays, obstacles, assumed
        self._s, self._f, _, theta = state
        self._sin, self._cos = models.sine(theta), models.cosine(theta)
        self.symbols = models.symbols(self._s)
        self.known: dict[tuple[Any, ...], Any] = {}
        self._faces = [[(o, k) for k in range(len(x))] for o, x in enumerate(obstacles)]
        self._near = [faces for faces in self._faces if not any(map(self._far, faces))]

    def _far(self, face: Face) -> bool:
        """Tell whether what is behind a face is out of range of every member of the row."""
        size = models.length(self._obstacles[face[0]][face[1]])
        return bool(self._outside(face) > self._rays.reach * size)

    # --- quantities of faces ---------------------------------------------------------------

    @_once
    def _miss(self, face: Face) -> Model:
        """Return g."""
        return models.line(self._obstacles[face[0]][face[1]], self._s, self._f)

    @_once
    def _outside(self, face: Face) -> arb:
        return bound(self._miss(face))

    @_once
    def _rate(self, face: Face) -> Pair:
        """Return h."""
        a, b, _ = map(arb, self._obstacles[face[0]][face[1]])
        ahead = add(scale(self._sin, a), scale(self._cos, b))
        return ahead, subtract(scale(self._cos, a), scale(self._sin, b))

    @_once
    def _inverse(self, face: Face) -> Pair:
        """Return u, for a distant face."""
        over, (ahead, across) = models.reciprocal(self._miss(face)), self._rate(face)
        return multiply(ahead, over), multiply(across, over)

    @_once
    def cross(self, j: Face, k: Face) -> Pair:
        """Return X_jk."""
        if j > k:
            p, q = self.cross(k, j)
            return models.negative(p), models.negative(q)
        (p, q), (r, s), g, f = self._rate(k), self._rate(j), self._miss(j), self._miss(k)
        return subtract(multiply(p, g), multiply(r, f)), subtract(multiply(q, g), multiply(s, f))

    def along(self, pair: Pair, ray: int) -> Model:
        """Return the model of a quantity along a ray."""
        c, s = self._rays.directions[ray, 0], self._rays.directions[ray, 1]
        return [c * x + s * y for x, y in zip(*pair, strict=True)]

    @_once
    def _ranges(self, name: str, *faces: Face) -> list[arb]:
        """Return the ranges of a quantity along all rays."""
        return models.bounds(self._rays.directions * arb_mat(getattr(self, name)(*faces)))

    @_once
    def _middles(self, name: str, *faces: Face) -> list[float]:
        """Return a quantity at the middle of the row along all rays; a guide, no proof."""
        middle = arb_mat([[z[0]] for z in getattr(self, name)(*faces)])
        return [float(x) for x in (self._rays.directions * middle).entries()]

    # --- one ray ---------------------------------------------------------------------------

    def _distant(self, face: Face) -> bool:
        """Tell whether all cars are outside of a face by more than NEAREST."""
        return bool(self._outside(face) > NEAREST)

    def _given(self, j: Face, k: Face, ray: int) -> int:
        """Return the sign of X_jk that is assumed, 0 if none is.

        Members with X_jk = 0 satisfy both assumptions and belong to both children of a guard:
        it suffices that one of the two is right about them.
        """
        for (o, a), (_, b), sign in ((j, k, 1), (k, j, -1)):
            if (ray, o, a, b) in self._assumed:
                return sign if self._assumed[ray, o, a, b] else -sign
        return 0

    def _sign(self, j: Face, k: Face, ray: int) -> int:
        """Return 1 if X_jk >= 0 is assumed or proved, -1 if X_jk < 0, 0 if it is open."""
        x = self._ranges("cross", j, k)[ray]
        return self._given(j, k, ray) or (1 if x >= 0 else -1 if x < 0 else 0)

    def _winner(self, ray: int) -> Face | None:
        """Return the face met by a ray from the middle of the row, None for none; a guess."""
        best, winner = float(1 / self._rays.reach), None
        for faces in self._near:
            for j in filter(self._distant, faces):
                if self._middles("_inverse", j)[ray] > best and all(
                    (self._given(j, k, ray) or self._middles("cross", j, k)[ray]) >= 0
                    for k in faces
                    if k != j
                ):
                    best, winner = self._middles("_inverse", j)[ray], j
        return winner

    def _met(self, j: Face, ray: int) -> Model:
        """Return u of an obstacle that is hit: at face j or, where one is crossed later, there."""
        u, faces = self.along(self._inverse(j), ray), self._faces[j[0]]
        for k in faces:
            if k == j or self._sign(j, k, ray) > 0:
                continue
            others = [i for i in faces if i != k and not self._distant(i)]
            hit = self._distant(k) and all(self._sign(k, i, ray) > 0 for i in others)
            require(hit, f"ray {ray} may miss face {j[1]} of obstacle {j[0]}, or hit it")
            u = models.minimum(u, self.along(self._inverse(k), ray))
        return u

    def _behind(self, u: Model, faces: list[Face], ray: int) -> Model:
        """Return the larger one of u and that of another obstacle, if that is hit."""
        found, distant = [], filter(self._distant, faces)
        for k in sorted(distant, key=lambda k: self._middles("_inverse", k)[ray]):
            v = self.along(self._inverse(k), ray)
            more = bound(subtract(v, u))
            if more <= 0:
                return u
            found.append((more.upper(), k, v))
        if any(self._passes(j, k, ray) for j in faces for k in faces):
            return u
        require(found, f"ray {ray} may hit obstacle {faces[0][0]} or not")
        _, j, v = found[0]
        if all(k == j or self._sign(j, k, ray) > 0 for k in faces):
            return models.maximum(u, v)
        least = reduce(arb.min, (more for more, *_ in found))
        return plus(u, least * models.SHARE)

    def _passes(self, j: Face, k: Face, ray: int) -> bool:
        """Tell whether a ray surely misses an obstacle by faces j and k.

        The car is outside of j; where the ray comes inside of j it is outside of k, and it does
        not come inside of k beyond; or it never comes inside of j (j = k).
        """
        if not self._outside(j) > 0:
            return False
        if j == k:
            return bool(self._ranges("_rate", j)[ray] <= 0)
        beyond = self._outside(k) <= 0 or self._ranges("_rate", k)[ray] <= 0
        return bool(beyond) and self._sign(j, k, ray) < 0

    def reading(self, ray: int) -> Model:
        """Return the model of the distance along a ray, at most the range."""
        winner, u = self._winner(ray), models.constant(1 / self._rays.reach, self.symbols)
        if winner is not None:
            u = models.maximum(u, self._met(winner, ray))
        for faces in self._near:
            if winner is None or faces[0][0] != winner[0]:
                u = self._behind(u, faces, ray)
        return models.inverse_from(u, 1 / self._rays.reach)

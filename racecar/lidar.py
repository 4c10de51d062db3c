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

Before any work is done per car, the bounding box of a batch shows what is out of range, or
holds everywhere in range, and that is dropped.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from racecar.errors import BadInput
from racecar.polygon import Array, Polygon, Stack, bounding_box, pair, stacked

#: Beyond every inverse distance that matters.
_HUGE = 1e300
#: A car this near to a wall's line (metres) is on it.
_TOUCHING = 1e-200
#: This near (metres) the bounding box does not tell on which side of the line cars are.
_UNSURE = 1e-9
#: So many readings are made at a time: they stay in the processor's cache.
_READINGS_AT_ONCE = 100_000


@dataclass(frozen=True, eq=False)
class _View:
    """One wall as a batch of cars sees it.

    Each array holds ``h / g`` of one constraint as the factors of (cosine, sine, and maybe 1)
    of a ray's angle: ``[2 or 3, batch]``. entries: constraints that cars are outside of;
    exits: constraints that cars are inside of.
    """

    entries: list[Array]
    exits: list[Array]


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
    def _directions(self) -> dict[int, Array]:
        """(cosine, sine) and (cosine, sine, 1) of the ray angles, by their number."""
        rows = np.stack([np.cos(self.angles), np.sin(self.angles), np.ones(self.rays)])
        return {2: rows[:2], 3: rows}

    def scan(
        self, obstacles: Sequence[Polygon], s: ArrayLike, f: ArrayLike, theta: ArrayLike
    ) -> Array:
        """Return distances ``[batch, rays]`` in metres for states ``[batch]`` (m, m, rad).

        A car inside an obstacle, or on its edge, reads 0 on every ray.
        """
        s, f, theta = (np.atleast_1d(np.asarray(x, dtype=float)) for x in (s, f, theta))
        scan = np.empty((s.size, self.rays))
        if s.size:
            views, inside = _views(stacked(obstacles), self.range, s, f, theta)
            for cars in _slices(s.size, _READINGS_AT_ONCE // self.rays):
                self._measure(views, inside, cars, scan[cars])
        return scan

    def scan_rows(self, obstacles: Sequence[Polygon], s: Array, f: Array, theta: Array) -> Array:
        """Return the same scan with one row per ray, ``[rays, batch]``: a transposed view."""
        return self.scan(obstacles, s, f, theta).T

    def scan_blocks(
        self, obstacles: Sequence[Polygon], s: Array, f: Array, theta: Array, block: Array
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the same scan in blocks: (which cars, ``[cars, rays]``).

        block: ``[cars at a time, rays]``, memory for all blocks; each is good until the next.
        """
        if not s.size:
            return
        views, inside = _views(stacked(obstacles), self.range, s, f, theta)
        for cars in _slices(s.size, len(block)):
            scan = block[: s.size - cars.start]
            self._measure(views, inside, cars, scan)
            yield cars, scan

    def _measure(self, views: list[_View], inside: Array | None, cars: slice, scan: Array) -> None:
        """Fill ``scan``, ``[cars, rays]``."""
        scratch = _scratch(scan.size).reshape(3, *scan.shape)
        scan.fill(1 / self.range)
        for view in views:
            np.maximum(scan, self._first_hit(view, cars, scratch), out=scan)
        np.reciprocal(scan, out=scan)
        if inside is not None:
            scan[inside[cars]] = 0.0

    def _first_hit(self, view: _View, cars: slice, scratch: Array) -> Array:
        """Return the inverse distance to a wall, ``[cars, rays]``; at most 0 for no hit.

        scratch: three arrays of the answer's shape.
        """
        first, last, ratio = scratch
        self._extreme(np.minimum, view.entries, cars, first, ratio)
        if view.exits:
            self._extreme(np.maximum, view.exits, cars, last, ratio)
            np.multiply(first, first >= last, out=first)
        return first

    def _extreme(
        self, pick: np.ufunc, factors: list[Array], cars: slice, out: Array, ratio: Array
    ) -> None:
        """Write the least or largest ``h / g`` of several constraints to ``out``."""
        for i, factor in enumerate(factors):
            target = ratio if i else out
            np.matmul(factor[:, cars].T, self._directions[len(factor)], out=target)
            if i:
                pick(out, ratio, out=out)


def _slices(size: int, at_once: int) -> Iterator[slice]:
    step = max(1, at_once)
    return (slice(begin, begin + step) for begin in range(0, size, step))


_kept = threading.local()


def _scratch(size: int) -> Array:
    """Return three arrays ``[3, size]``, kept between calls: fresh memory is slow to touch."""
    flat: Array | None = getattr(_kept, "flat", None)
    if flat is None or flat.size < 3 * size:
        flat = _kept.flat = np.empty(3 * size)
    return flat[: 3 * size].reshape(3, size)


def _views(
    walls: Stack, reach: float, s: Array, f: Array, theta: Array
) -> tuple[list[_View], Array | None]:
    """Return what cars can see of the walls within ``reach`` (m), and who is inside one.

    Comparisons are such that NaN keeps a wall.
    """
    points = pair(s, f)
    least, most = walls.bounds(bounding_box(points), reach)
    near = ~(walls.largest(least) > 0)
    kept = np.flatnonzero(near[walls.owner] & ~(most <= 0))
    normals, slack = walls.normals[kept], reach * walls.norms[kept]
    misses = normals @ points
    misses -= walls.offsets[kept, None]
    lows, highs = (least[kept] + slack).tolist(), (most[kept] - slack).tolist()
    sides = [_side(low, high) for low, high in zip(lows, highs, strict=True)]
    for j, side in enumerate(sides):
        if not side:
            misses[j] = np.where(np.abs(misses[j]) < _TOUCHING, -_TOUCHING, misses[j])
    ratios = _approaches(normals, theta)
    ratios /= misses[:, None]

    faces: dict[int, list[int]] = {k: [] for k in np.flatnonzero(near).tolist()}
    for j, k in enumerate(walls.owner[kept].tolist()):
        faces[k].append(j)
    views, inside = [], None
    for mine in faces.values():
        view = _View([], [])
        for j in mine:
            _add(view, sides[j], ratios[j], misses[j])
        if view.entries:
            views.append(view)
        if not any(sides[j] > 0 for j in mine):
            within = np.all(misses[mine] <= 0, axis=0)
            inside = within if inside is None else inside | within
    return views, inside


def _side(least: float, most: float) -> int:
    """Return 1 if all cars are outside of a constraint, -1 if all are inside, else 0."""
    return 1 if least > _UNSURE else -1 if most < -_UNSURE else 0


def _add(view: _View, side: int, ratio: Array, miss: Array) -> None:
    """Add a constraint to a view.

    Where cars are on both sides, a third factor, of a constant, makes a ratio that decides
    nothing for the cars of the other side.
    """
    if side > 0:
        view.entries.append(ratio)
    elif side < 0:
        view.exits.append(ratio)
    else:
        outside = miss > 0
        view.entries.append(np.concatenate([ratio * outside, [_HUGE * ~outside]]))
        view.exits.append(np.concatenate([ratio * ~outside, [-_HUGE * outside]]))


def _approaches(normals: Array, theta: Array) -> Array:
    """Return h of constraints as factors of the cosine and sine of a ray's angle.

    With sin and cos of the heading these are ``a_s sin + a_f cos`` and ``a_s cos - a_f sin``:
    ``[constraints, 2, batch]``.
    """
    turned = np.empty((2, 2, theta.size))
    np.sin(theta, out=turned[0, 0])
    np.cos(theta, out=turned[0, 1])
    turned[1, 0] = turned[0, 1]
    np.negative(turned[0, 0], out=turned[1, 1])
    return (normals @ turned.reshape(2, -1)).reshape(-1, 2, theta.size)

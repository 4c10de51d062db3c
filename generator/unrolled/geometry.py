"""Where the car can be, and which walls and unsafe sets decide anything there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from racecar.bicycle import Bicycle
from racecar.polygon import Array, Polygon


@dataclass(frozen=True, eq=False)
class StartBox:
    """Start states: lower and upper bounds of s, f (m), v (m/s) and theta (rad), ``[4]`` each."""

    lower: Array
    upper: Array


@dataclass(frozen=True, eq=False)
class Area:
    """Positions (s, f) in the first hall's frame: lower and upper bounds, ``[2]`` each, metres."""

    lower: Array
    upper: Array

    def within(self, lower: Sequence[float], upper: Sequence[float]) -> Area:
        """Return the part of the area between bounds; infinite ones do not bound."""
        return Area(np.maximum(self.lower, lower), np.minimum(self.upper, upper))

    def grown(self, distance: float) -> Area:
        """Return where a car from the area can be after driving so far (m)."""
        return Area(self.lower - distance, self.upper + distance)


def step_distances(car: Bicycle, period: float, steps: int) -> tuple[Array, Array]:
    """Return the distance driven in each step as ``slope * v0 + shift``: ``[steps]`` each.

    v0: the speed at the start; the speed does not depend on the steering.
    """
    before = np.exp(-car.acceleration * period * np.arange(steps))
    decay = -np.expm1(-car.acceleration * period) / car.acceleration
    slope = before * decay
    return slope, car.top_speed * (period - slope)


def walls_in_reach(walls: Sequence[Polygon], area: Area, reach: float) -> list[Polygon]:
    """Return the walls that a ray of length ``reach`` can hit from an area.

    Of each wall the constraints that hold at every point of the way are left out.
    """
    near = [wall.relevant(area.lower, area.upper, reach) for wall in walls]
    return [wall for wall in near if wall is not None and len(wall.offsets)]


def deciding(unsafe: Sequence[Polygon], area: Area) -> list[Polygon]:
    """Return the unsafe polygons, and their constraints, that decide the margin in an area."""
    bounds = [_misses(polygon, area) for polygon in unsafe]
    least = [low.max() for low, _ in bounds]
    limit = min(high.max() for _, high in bounds)
    kept = []
    for polygon, (_, high), low in zip(unsafe, bounds, least, strict=True):
        if low <= limit:
            largest = high >= low
            kept.append(Polygon(polygon.normals[largest], polygon.offsets[largest]))
    return kept


def kept_gap(unsafe: Sequence[Polygon], area: Area, normal: Array, offset: float) -> float:
    """Return a distance (m) by which a safe car in an area is outside of a constraint; maybe 0.

    It is known where an unsafe set is, in this area, the same half-plane moved outwards. Half of
    it is returned, so that no rounding of constants to float32 matters.
    """
    kept = 0.0
    for polygon in unsafe:
        here = polygon.relevant(area.lower, area.upper, 0.0)
        if here is not None and len(here.offsets) == 1 and np.array_equal(here.normals[0], normal):
            kept = max(kept, (float(here.offsets[0]) - offset) / 2)
    return kept


def _misses(polygon: Polygon, area: Area) -> tuple[Array, Array]:
    """Return the least and the largest miss of each constraint in an area."""
    positive, negative = np.maximum(polygon.normals, 0), np.minimum(polygon.normals, 0)
    low = positive @ area.lower + negative @ area.upper - polygon.offsets
    high = positive @ area.upper + negative @ area.lower - polygon.offsets
    return low, high

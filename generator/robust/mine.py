"""Which rays a controller misses most: the adversary of adversarial training."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import Plant, Steer
from racecar.raysets import all_sets, drawn_sets, least_margins


def worst_sets(
    plant: Plant, steer: Steer, most: int, random: np.random.Generator, drawn: int, kept: int
) -> NDArray[np.bool_]:
    """Return the ``kept`` sets of rays with the least margins: ``[rays, kept]``.

    Tried are every ray alone, every pair, and ``drawn`` random sets of ``most`` rays.
    """
    rays = plant.lidar.rays
    tried = [all_sets(rays, size) for size in (1, 2) if size <= most]
    if most > 2:
        tried.append(drawn_sets(rays, most, drawn, random))
    gone = np.concatenate(tried, axis=1)
    order = np.argsort(least_margins(plant, steer, gone), kind="stable")
    return gone[:, order[:kept]]

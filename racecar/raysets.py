"""Sets of missing rays, and how much room a controller keeps without them."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import Plant, State, Steer, simulate
from racecar.experiment import STEPS
from racecar.faults import GivenFaults
from racecar.polygon import Array
from racecar.safety import named_property

#: Starts (s, m) from which every set of rays is tried.
STARTS = (0.65, 0.75, 0.85)


def all_sets(rays: int, size: int) -> NDArray[np.bool_]:
    """Return every set of ``size`` rays: ``[rays, sets]``."""
    members = np.array(list(combinations(range(rays), size)), dtype=int)
    members = members.reshape(math.comb(rays, size), size)
    gone = np.zeros((rays, len(members)), dtype=bool)
    gone[members, np.arange(len(members))[:, None]] = True
    return gone


def drawn_sets(rays: int, size: int, count: int, random: np.random.Generator) -> NDArray[np.bool_]:
    """Return ``count`` sets of ``size`` rays drawn with replacement: ``[rays, count]``."""
    gone = np.zeros((rays, count), dtype=bool)
    gone[random.integers(rays, size=(size, count)), np.arange(count)] = True
    return gone


def least_margins(
    plant: Plant,
    steer: Steer,
    gone: NDArray[np.bool_],
    starts: tuple[float, ...] = STARTS,
) -> Array:
    """Return the least margin (m, continuous time) of each set of rays missing in the turn.

    gone: ``[rays, sets]``; starts: s of the benchmark's starts tried, metres. No noise.
    """
    missing = np.repeat(gone, len(starts), axis=1)
    start = State.start(np.tile(starts, gone.shape[1]))
    faults = GivenFaults(plant.track.width, plant.lidar.range, missing)
    safety = named_property("clearance", plant.track)
    runs = simulate(plant, steer, safety, start, STEPS, faults)
    return np.asarray(runs.margin.reshape(-1, len(starts)).min(axis=1))

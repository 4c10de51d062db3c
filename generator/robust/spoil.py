"""What goes wrong with scans in training: the paper's pattern, and a little more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from generator.hyperparams.robust import FaultArguments
from racecar.closed_loop import Plant, State
from racecar.faults import in_turn
from racecar.polygon import Array


@dataclass(frozen=True, eq=False)
class Spoil:
    """The faults of a batch of drives (closed_loop.Disturb).

    gone: ``[rays, cars]``, rays that are missing in the turn; level: ``[cars]``, upper end (m)
    of the one-sided noise; jitter: of the two-sided noise, metres.
    """

    plant: Plant
    gone: NDArray[np.bool_]
    level: Array
    jitter: float
    random: np.random.Generator

    def __call__(self, step: int, state: State, scan: Array) -> Array:
        """Return the scans ``[rays, cars]`` (m) with noise added and rays missing."""
        del step
        reach = self.plant.lidar.range
        noise = self.level * self.random.random(scan.shape)
        noise += self.random.uniform(-self.jitter, self.jitter, scan.shape)
        gone = self.gone & in_turn(state, self.plant.track.width)
        return np.where(gone, reach, np.clip(scan + noise, 0.0, reach))


def draw_spoil(
    plant: Plant,
    faults: FaultArguments,
    cars: int,
    share: float,
    worst: NDArray[np.bool_],
    random: np.random.Generator,
) -> Spoil:
    """Draw the faults of so many drives.

    share: in [0, 1], by which all of them are scaled; worst: ``[rays, sets]``, of which each
    mined drive takes one (there may be none).
    """
    rays, most = plant.lidar.rays, round(share * faults.missing)
    counts = random.integers(0, most + 1, cars)
    counts[random.random(cars) < faults.all_missing] = most
    gone = np.zeros((rays, cars), dtype=bool)
    for i, drawn in enumerate(random.integers(rays, size=(most, cars))):
        gone[drawn, np.arange(cars)] |= counts > i
    if faults.mined and worst.size:
        mined = random.random(cars) < faults.mined
        gone[:, mined] = worst[:, random.integers(worst.shape[1], size=int(mined.sum()))]
    level = share * faults.noise * random.choice(faults.noise_levels, cars)
    return Spoil(plant, gone, level, share * faults.jitter, random)

"""LiDAR faults: missing rays and noise, seeded run by run or given.

Random faults are drawn from a model; given ones, of a witness, are stated value by value. A
missing ray reads the LiDAR's range. The paper's pattern (section 6 there): five ray
indices drawn with replacement at the start of a run and kept for it, active only in the
turn, and on top noise uniform in [0, 0.2] m at every ray and step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.closed_loop import State
from racecar.errors import BadInput
from racecar.mirrors import Mirroring
from racecar.polygon import Array

#: The turn, for faults, begins this far (metres) before the corner square.
TURN_LEAD = 1.0


@dataclass(frozen=True)
class Faults:
    """A random fault model.

    missing: how many ray indices are drawn (with replacement) for each run; turn_only:
    whether they are missing only where ``0 < s < W and f <= W + 1``; noise: upper end
    (metres) of the uniform noise added to every reading, before clipping at the range.
    """

    missing: int = 0
    turn_only: bool = True
    noise: float = 0.0

    def __post_init__(self) -> None:
        if self.missing < 0:
            raise BadInput(f"faults: {self.missing} missing rays; give 0 or more")
        if not 0 <= self.noise < np.inf:
            raise BadInput(f"faults: noise is {self.noise} m; give 0 or more")

    def draw(
        self, rays: int, runs: int, width: float, reach: float, random: np.random.Generator
    ) -> DrawnFaults:
        """Draw the faults of ``runs`` runs.

        width: of the halls (metres); reach: range of the LiDAR (metres).
        """
        gone = np.zeros((rays, runs), dtype=bool)
        if self.missing:
            drawn = random.integers(rays, size=(self.missing, runs))
            gone[drawn, np.arange(runs)] = True
        return DrawnFaults(self, gone, width, reach, random)


@dataclass(frozen=True, eq=False)
class DrawnFaults:
    """The faults of a batch of runs; called on each scan in turn (closed_loop.Disturb).

    gone: ``[rays, runs]``, which rays are missing.
    """

    faults: Faults
    gone: NDArray[np.bool_]
    width: float
    reach: float
    random: np.random.Generator

    def __call__(self, step: ArrayLike, state: State, scan: Array) -> Array:
        """Return the scan ``[rays, runs]`` (metres) with noise added and rays missing."""
        del step
        if self.faults.noise:
            noise = self.faults.noise * self.random.random(scan.shape[::-1]).T
            scan = np.minimum(scan + noise, self.reach)
        if self.faults.missing:
            scan = np.where(self.missing(0, state, scan), self.reach, scan)
        return scan

    def missing(self, step: ArrayLike, state: State, scan: Array) -> NDArray[np.bool_]:
        """Return which rays are missing, ``[rays, runs]``; scan: undisturbed, metres."""
        del step, scan
        return self.gone & in_turn(state, self.width) if self.faults.turn_only else self.gone

    def renewed(self, which: NDArray[np.bool_], fresh: DrawnFaults) -> DrawnFaults:
        """Return the faults with those of the runs ``which`` (mask) replaced by fresh ones."""
        gone = self.gone.copy()
        gone[:, which] = fresh.gone
        return replace(self, gone=gone)


@dataclass(frozen=True, eq=False)
class GivenFaults:
    """Faults of a batch of runs, value by value; called on each scan (closed_loop.Disturb).

    Noise is added, the sum is clipped to [0, reach], and then rays that are missing and rays
    that a mirroring wall takes read ``reach``.

    width: of the halls (metres); reach: range of the LiDAR (metres); gone: which rays are
    missing, ``[rays, runs]`` for the whole run or ``[steps, rays, runs]``; turn_only: whether
    they are missing only where ``0 < s < W and f <= W + 1``; noise: ``[steps, rays, runs]``,
    metres; mirrors: which stretch of wall mirrors, in the turn or not.
    """

    width: float
    reach: float
    gone: NDArray[np.bool_] | None = None
    turn_only: bool = True
    noise: Array | None = None
    mirrors: Mirroring | None = None

    def __call__(self, step: int, state: State, scan: Array) -> Array:
        """Return the scan ``[rays, runs]`` (metres) with noise added and rays missing."""
        noisy = scan
        if self.noise is not None:
            noisy = np.clip(scan + self.noise[step], 0.0, self.reach)
        if self.gone is None and self.mirrors is None:
            return noisy
        return np.where(self.missing(step, state, scan), self.reach, noisy)

    def missing(self, step: int, state: State, scan: Array) -> NDArray[np.bool_]:
        """Return which rays read ``reach``, ``[rays, runs]``; scan: undisturbed, metres."""
        missing = np.zeros(scan.shape, dtype=bool)
        if self.gone is not None:
            gone = self.gone[step] if self.gone.ndim == 3 else self.gone
            missing |= gone & in_turn(state, self.width) if self.turn_only else gone
        if self.mirrors is not None:
            missing |= self.mirrors.lost(state, scan)
        return missing


def in_turn(state: State, width: float) -> NDArray[np.bool_]:
    """Return which cars are in the paper's turn region, where its faults are active."""
    return (state.s > 0) & (state.s < width) & (state.f <= width + TURN_LEAD)


#: Fault models by name, for commands and environments.
FAULTS = {
    "none": Faults(),
    "paper": Faults(missing=5, noise=0.2),
    "noise": Faults(noise=0.1),
}

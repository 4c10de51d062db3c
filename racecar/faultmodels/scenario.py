"""Fault scenarios: a fault model's draws for some runs, value by value.

Where a model says how faults are drawn, a scenario says what was drawn, so that a program that
knows nothing of our random numbers can drive the same runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import Plant, State
from racecar.faultmodels.draw import SpecFaults
from racecar.faultmodels.spec import MeasuredNoise, Noise, OneOf, Reflective
from racecar.faults import in_turn
from racecar.mirrors import lost_rays
from racecar.polygon import Array


@dataclass(frozen=True, eq=False)
class DrawnPart:
    """What one part of a model does to the runs.

    kind: as in the model; happens: ``[runs]``, to which runs it happens; noise: ``[steps, runs,
    rays]``, metres, or None; missing: ``[runs, rays]`` for the whole run or ``[steps, runs,
    rays]``, or None; turn_only: whether rays are missing only in the turn; ends: ``[segments,
    runs, 2, 2]``, of mirrors in the global frame, metres, or None; incidence: rad.
    """

    kind: str
    happens: NDArray[np.bool_]
    noise: Array | None = None
    missing: NDArray[np.bool_] | None = None
    turn_only: bool = False
    ends: Array | None = None
    incidence: float = 0.0


@dataclass(frozen=True, eq=False)
class Scenario:
    """Drawn faults of a batch of runs; called on each scan (closed_loop.Disturb)."""

    plant: Plant
    parts: tuple[DrawnPart, ...]

    def __call__(self, step: int, state: State, scan: Array) -> Array:
        """Return the scan ``[rays, runs]`` (metres) with noise added and rays missing."""
        noisy, gone = scan, np.zeros(scan.shape, dtype=bool)
        for part in self.parts:
            if part.noise is not None:
                noisy = noisy + part.noise[step].T * part.happens
            elif part.missing is not None:
                missing = part.missing[step] if part.missing.ndim == 3 else part.missing
                active = in_turn(state, self.plant.track.width) | (not part.turn_only)
                gone |= missing.T & active & part.happens
            elif part.ends is not None:
                gone |= part.happens & lost_rays(self.plant, part.incidence, part.ends, state, scan)
        reach = self.plant.lidar.range
        return np.where(gone, reach, np.clip(noisy, 0.0, reach))


def draw_scenario(faults: SpecFaults, steps: int) -> Scenario:
    """Return what a model draws for its runs in so many steps."""
    parts = []
    for key, part, chosen in faults.drawn_parts():
        happens = np.ones(len(faults.runs), dtype=bool) if chosen is None else chosen
        if isinstance(part, Noise | MeasuredNoise):
            noise = np.stack([faults.noise_drawn(key, part, i).T for i in range(steps)])
            parts.append(DrawnPart(part.kind, happens, noise=noise))
        elif isinstance(part, Reflective):
            ends = faults.ends_drawn(key, part)
            parts.append(DrawnPart(part.kind, happens, ends=ends, incidence=part.incidence))
        else:
            assert not isinstance(part, OneOf)
            several = range(steps) if part.choice == "step" else range(1)
            missing = np.stack([faults.rays_drawn(key, part, i).T for i in several])
            missing = missing if part.choice == "step" else missing[0]
            parts.append(DrawnPart(part.kind, happens, missing=missing, turn_only=part.turn_only))
    return Scenario(faults.plant, tuple(parts))

"""Candidates for a witness: starts, each with a disturbance that the instance allows.

The disturbance of a candidate is the simplest of its kind: the same noise, missing rays and
mirror at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import Plant
from racecar.disturbance import Disturbance
from racecar.faults import GivenFaults
from racecar.instance import Instance
from racecar.mirrors import mirroring
from racecar.polygon import Array
from racecar.witness import Witness


@dataclass(frozen=True, eq=False)
class Candidates:
    """A batch of candidates.

    starts: ``[n, 4]`` (s, f, v, theta); noise: ``[n, rays]``, metres; gone: ``[n, rays]``, which
    rays are missing; mirror: ``[n]``, the index of the segment that mirrors, or -1.
    """

    starts: Array
    noise: Array
    gone: NDArray[np.bool_]
    mirror: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.starts)

    def take(self, index: NDArray[np.intp]) -> Candidates:
        """Return the candidates at ``index``."""
        return Candidates(
            self.starts[index], self.noise[index], self.gone[index], self.mirror[index]
        )

    @staticmethod
    def join(parts: Sequence[Candidates]) -> Candidates:
        """Return all candidates of several batches."""
        return Candidates(
            np.concatenate([x.starts for x in parts]),
            np.concatenate([x.noise for x in parts]),
            np.concatenate([x.gone for x in parts]),
            np.concatenate([x.mirror for x in parts]),
        )

    def at(self, starts: Array) -> Candidates:
        """Return candidates with the same disturbances and other starts."""
        return Candidates(starts, self.noise, self.gone, self.mirror)

    def faults(self, instance: Instance, plant: Plant) -> GivenFaults | None:
        """Return the disturbances of all candidates; None if the instance has none."""
        given = instance.disturbance
        if given is None:
            return None
        shape = (instance.steps, plant.lidar.rays, len(self))
        return GivenFaults(
            plant.track.width,
            plant.lidar.range,
            self.gone.T,
            given.turn_only,
            np.broadcast_to(self.noise.T, shape) if given.noise else None,
            mirroring(given.mirrors, plant, self.mirror),
        )

    def witness(self, index: int, instance: Instance) -> Witness:
        """Return a candidate as the instance wants a witness."""
        given, steps = instance.disturbance, instance.steps
        s, f, v, theta = (float(x) for x in self.starts[index])
        missing: list[int] | list[list[int]] | None = None
        noise, mirror = None, None
        if given is not None and self.gone[index].any():
            rays = np.flatnonzero(self.gone[index]).tolist()
            missing = rays if given.choice == "run" else [rays] * steps
        if given is not None and given.noise:
            noise = [self.noise[index].tolist()] * steps
        if self.mirror[index] >= 0:
            mirror = int(self.mirror[index])
        return Witness(s=s, f=f, v=v, theta=theta, missing=missing, noise=noise, mirror=mirror)


def disturbed(
    starts: Array, given: Disturbance | None, rays: int, random: np.random.Generator
) -> Candidates:
    """Return the starts with disturbances drawn from what is allowed; segments go in turn."""
    count = len(starts)
    quiet = Candidates(
        starts,
        np.zeros((count, rays)),
        np.zeros((count, rays), dtype=bool),
        np.full(count, -1, dtype=np.intp),
    )
    if given is None:
        return quiet
    gone = quiet.gone
    if given.missing:
        for row in gone:
            row[random.choice(rays, random.integers(given.missing + 1), replace=False)] = True
    # Noise moves the steering most at its bound: all rays alike, or each ray to its own side.
    alike, sides = random.random((count, 1)) < 0.3, random.choice([-1.0, 1.0], (count, rays))
    strength = given.noise * random.choice([-1.0, 0.0, 1.0], (count, 1), p=[0.4, 0.2, 0.4])
    noise = strength * np.where(alike, 1.0, sides)
    choices = len(given.mirrors.segments) + 1 if given.mirrors is not None else 1
    return Candidates(starts, noise, gone, np.arange(count) % choices - 1)


def crossed(
    own: Candidates, other: Candidates, given: Disturbance | None, random: np.random.Generator
) -> Candidates:
    """Return candidates of which some take noise, missing rays or mirror from another."""
    if given is None:
        return own
    noise, gone, mirror = (random.random((len(own), 1)) < 0.3 for _ in range(3))
    return Candidates(
        own.starts,
        np.where(noise, other.noise, own.noise),
        np.where(gone, other.gone, own.gone),
        np.where(mirror[:, 0], other.mirror, own.mirror),
    )

"""The disturbances that a witness gives: their shape, whether they are allowed, as faults."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from racecar.faults import GivenFaults
from racecar.instance import Instance
from racecar.mirrors import mirroring
from racecar.witness import Witness


class Malformed(Exception):
    """A witness that cannot be read; the message says why."""


def check_shape(instance: Instance, witness: Witness) -> None:
    """Raise Malformed if the disturbances have not the shape that the instance asks for."""
    disturbance, rays = instance.disturbance, instance.plant.lidar.rays
    if disturbance is None:
        for name in ("missing", "noise", "mirror"):
            if getattr(witness, name) is not None:
                raise Malformed(f"{name}: the instance has no disturbance")
        return
    if witness.mirror is not None and disturbance.mirrors is None:
        raise Malformed("mirror: no wall of the instance mirrors")
    if witness.missing and witness.missing_per_step != (disturbance.choice == "step"):
        one = "a list of rays for each step" if disturbance.choice == "step" else "one list of rays"
        raise Malformed(f"missing: the instance asks for {one}")
    for name, rows in _rows(instance, witness).items():
        if len(rows) > instance.steps:
            raise Malformed(f"{name}: {len(rows)} lists for {instance.steps} steps")
    for step, row in enumerate(witness.noise or ()):
        if len(row) != rays:
            raise Malformed(f"noise.{step}: {len(row)} numbers for {rays} rays")


def complaint(instance: Instance, witness: Witness) -> str | None:
    """Return why missing rays or mirror (of the right shape) are not allowed; None if they are."""
    disturbance, rays = instance.disturbance, instance.plant.lidar.rays
    if disturbance is None:
        return None
    for row in witness.missing_lists:
        if any(not 0 <= ray < rays for ray in row):
            return f"a missing ray is not one of 0 to {rays - 1}"
        if len(set(row)) > disturbance.missing:
            allowed = disturbance.missing
            return f"{len(set(row))} rays are missing at a time, {allowed} may be"
    if witness.mirror is not None and disturbance.mirrors is not None:
        count = len(disturbance.mirrors.segments)
        if not 0 <= witness.mirror < count:
            return f"the mirror {witness.mirror} is not one of the segments 0 to {count - 1}"
    return None


def given_steps(instance: Instance, witness: Witness) -> int:
    """Return for how many control periods the witness says all that it has to."""
    lengths = [len(rows) for rows in _rows(instance, witness).values()]
    return min([instance.steps, *lengths])


def make_faults(instance: Instance, witness: Witness) -> GivenFaults | None:
    """Return the disturbances as faults of one run; None if the instance has none.

    They must be of the right shape, and the missing rays and the mirror allowed.
    """
    disturbance, lidar = instance.disturbance, instance.plant.lidar
    if disturbance is None:
        return None
    gone: NDArray[np.bool_] | None = None
    if witness.missing:
        table = np.zeros((len(witness.missing_lists), lidar.rays, 1), dtype=bool)
        for step, row in enumerate(witness.missing_lists):
            table[step, row] = True
        gone = table[0] if disturbance.choice == "run" else table
    noise = np.array(witness.noise)[..., None] if witness.noise else None
    mirrors = None
    if witness.mirror is not None:
        mirrors = mirroring(disturbance.mirrors, instance.make_plant(), witness.mirror)
    width, turn_only = instance.plant.width, disturbance.turn_only
    return GivenFaults(width, lidar.range, gone, turn_only, noise, mirrors)


def _rows(instance: Instance, witness: Witness) -> dict[str, list]:
    """Return the lists that a witness gives step by step, by name."""
    rows: dict[str, list] = {}
    if witness.noise is not None:
        rows["noise"] = witness.noise
    step = instance.disturbance is not None and instance.disturbance.choice == "step"
    if witness.missing is not None and step:
        rows["missing"] = witness.missing
    return rows

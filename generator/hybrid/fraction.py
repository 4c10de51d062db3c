"""Rays whose reading so far is a fraction num / den: what arithmetic without division can say.

The direction of the ray at work is the sum of the heading, as ct = cos theta and st = sin theta,
and of its fixed angle, whose cosine and sine are rounded to the nearest double.
"""

from __future__ import annotations

import numpy as np

from generator.hybrid.automaton import Assignment, Constraint, StateVariable
from generator.hybrid.dialect import Row, Sight
from generator.hybrid.expression import Variable, constant
from racecar.instance import Instance

COS, SIN = Variable("ct"), Variable("st")
#: Of the ray at work: cosine and sine of its fixed angle; it reads NUM / DEN so far.
AIM_COS, AIM_SIN = Variable("ca"), Variable("sa")
NUM, DEN = Variable("num"), Variable("den")


class FractionRays:
    """The part of a dialect that aims a ray and finds the nearest face."""

    def __init__(self, instance: Instance) -> None:
        self.plant = instance.plant
        angles = instance.make_plant().lidar.angles
        self.directions = list(zip(np.cos(angles).tolist(), np.sin(angles).tolist(), strict=True))

    def ray_variables(self) -> list[StateVariable]:
        """Return the variables of the ray at work."""
        return [
            StateVariable("ca", "cosine of the angle of the ray at work"),
            StateVariable("sa", "sine of the angle of the ray at work"),
            StateVariable("num", "the ray at work reads num / den so far", "m"),
            StateVariable("den", "the ray at work reads num / den so far"),
        ]

    def sight(self) -> Sight:
        """Return the direction of the ray at work."""
        return Sight(SIN * AIM_COS + COS * AIM_SIN, COS * AIM_COS - SIN * AIM_SIN)

    def aim(self, ray: int) -> list[Assignment]:
        """Return resets that begin a ray (from 1)."""
        cosine, sine = self.directions[ray - 1]
        return [
            Assignment("ca", constant(cosine)),
            Assignment("sa", constant(sine)),
            Assignment("num", constant(self.plant.lidar.range)),
            Assignment("den", constant(1.0)),
        ]

    def nearer(self, sight: Sight, row: Row) -> Constraint:
        """Say that a face is no farther than what the ray at work reads so far."""
        return Constraint(sight.gap(row) * DEN - sight.approach(row) * NUM, "<=", 0.0)

    def hit(self, sight: Sight, row: Row) -> list[Assignment]:
        """Return resets that let the ray at work read the distance to a face."""
        return [Assignment("num", sight.gap(row)), Assignment("den", sight.approach(row))]

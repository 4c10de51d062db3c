"""What may disturb the LiDAR in an instance: bounded noise, missing rays, a wall that mirrors.

Unlike the random models of racecar.faults this is a set: the question is whether any member
of it makes the car unsafe.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from racecar.data import Data, NotNegative
from racecar.faultmodels.spec import Segment


class Mirrors(Data):
    """Stretches of wall, of which at most one, whichever, mirrors for the whole run.

    A ray whose first hit is on that stretch (its ends included), with more than ``incidence``
    between the ray and the wall's normal, reads the range. Both are told by the true geometry.
    """

    segments: Annotated[tuple[Segment, ...], Field(min_length=1)]
    incidence: float = Field(ge=0, lt=math.pi / 2, description="rad, from the wall's normal")


class Disturbance(Data):
    """A set of disturbances of the readings.

    Every reading d (clipped at the LiDAR's range already) becomes ``min(max(d + n, 0), range)``
    with ``|n| <= noise``, anew for every ray and control instant. Then up to ``missing`` rays
    read the range, and those that a mirroring wall takes.
    """

    noise: NotNegative = Field(description="m; 0: none")
    missing: int = Field(ge=0, description="at most so many rays; 0: none")
    turn_only: bool = Field(
        description="rays are missing only at control instants at which 0 < s < W and f <= W + 1 "
        "in the frame of the car's hall, W the plant's width"
    )
    choice: Literal["run", "step"] = Field(
        description="which rays are missing: the same for the whole run, or anew at every step"
    )
    mirrors: Mirrors | None = Field(default=None, description="left out if no wall mirrors")

    @model_validator(mode="after")
    def _some(self) -> Self:
        if self.noise == 0 and self.missing == 0 and self.mirrors is None:
            raise ValueError("no noise, missing rays or mirrors; leave the disturbance out")
        return self

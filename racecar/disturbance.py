"""What may disturb the LiDAR in an instance: bounded noise and missing rays.

Unlike the random models of racecar.faults this is a set: the question is whether any member
of it makes the car unsafe.
"""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from racecar.data import Data, NotNegative


class Disturbance(Data):
    """A set of disturbances of the readings.

    Every reading d (clipped at the LiDAR's range already) becomes ``min(max(d + n, 0), range)``
    with ``|n| <= noise``, anew for every ray and control instant. Then up to ``missing`` rays
    read the range.
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

    @model_validator(mode="after")
    def _some(self) -> Self:
        if self.noise == 0 and self.missing == 0:
            raise ValueError("neither noise nor missing rays; leave the disturbance out")
        return self

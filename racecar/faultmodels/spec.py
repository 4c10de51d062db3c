"""Fault models as JSON: strict, versioned, each part one thing that goes wrong.

All noise is added first and the sum is clipped to the LiDAR's range; then missing rays read the
range. So the order of the parts does not matter.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from racecar.data import Data, Number, Positive, parse_data
from racecar.errors import BadInput

Share = Annotated[float, Field(allow_inf_nan=False, ge=0, le=1)]
Choice = Annotated[
    Literal["run", "step"], Field(description="drawn once for the whole run, or anew at every step")
]
TurnOnly = Annotated[
    bool,
    Field(
        description="missing only at control instants at which 0 < s < W and f <= W + 1 in the "
        "frame of the car's hall, W the width"
    ),
]
Point = Annotated[tuple[Number, Number], Field(description="s and f, m")]


class MissingRays(Data):
    """Rays drawn one by one, with replacement: fewer are missing where one is drawn twice."""

    kind: Literal["missing"]
    rays: int = Field(ge=1, description="how many are drawn")
    choice: Choice
    turn_only: TurnOnly


class MissingBlock(Data):
    """Neighbouring rays, at a place that is drawn: all places that fit are equally likely."""

    kind: Literal["block"]
    rays: int = Field(ge=1, description="how many neighbours")
    choice: Choice
    turn_only: TurnOnly


class Dropout(Data):
    """Every ray by itself is missing with some probability."""

    kind: Literal["dropout"]
    probability: Share
    choice: Choice
    turn_only: TurnOnly


class Segment(Data):
    """A stretch of a wall, as coordinates in the frame of a hall."""

    hall: int = Field(ge=0, description="index of the hall in whose frame the points are")
    begin: Point
    end: Point


class DrawnSegments(Data):
    """Stretches of the outer walls at the first turn, at places drawn for each run.

    The places are uniform over the left wall and the front wall of the first hall, up to
    ``within`` metres from the corner that they share.
    """

    count: int = Field(ge=1)
    length: Positive = Field(description="m")
    within: Positive = Field(description="m")


class Reflective(Data):
    """Walls that mirror: a ray that meets one at too shallow an angle never comes back.

    It reads the range where the angle between the ray and the wall's normal is larger than
    ``incidence``.
    """

    kind: Literal["reflective"]
    incidence: float = Field(ge=0, lt=math.pi / 2, description="rad, from the wall's normal")
    segments: tuple[Segment, ...] = ()
    drawn: DrawnSegments | None = None

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.segments and self.drawn is None:
            raise ValueError("neither segments nor drawn; give one of them")
        return self


class Noise(Data):
    """Noise uniform between two bounds, drawn for every ray and step."""

    kind: Literal["noise"]
    low: Number = Field(description="m")
    high: Number = Field(description="m")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low is {self.low} m, above high, {self.high} m")
        return self


class MeasuredNoise(Data):
    """Errors as measured on a real car: log-normal in size, of either sign alike.

    Drawn for every ray and step.
    """

    kind: Literal["measured"]
    median: Positive = Field(description="of the error's size, m")
    percentile95: Positive = Field(description="of the error's size, m")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.percentile95 < self.median:
            raise ValueError("percentile95 is below the median")
        return self


class Weighted(Data):
    """One of several things that can happen to a run."""

    weight: Positive = Field(description="relative to the others'")
    parts: tuple[Part, ...] = Field(description="none: nothing goes wrong")


class OneOf(Data):
    """A mixture: for each run one of the choices is drawn."""

    kind: Literal["one_of"]
    choices: tuple[Weighted, ...] = Field(min_length=1)


Part = Annotated[
    MissingRays | MissingBlock | Dropout | Reflective | Noise | MeasuredNoise | OneOf,
    Field(discriminator="kind"),
]


class FaultSpec(Data):
    """A fault model."""

    format: Literal["closedlap-faults"]
    version: Literal[1]
    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    description: str = Field(min_length=1)
    parts: tuple[Part, ...] = Field(description="all of them happen")

    def to_json(self) -> str:
        """Return the model as JSON text."""
        return self.model_dump_json(indent=2, exclude_none=True) + "\n"

    def sha256(self) -> str:
        """Return a hash of what the model says, not of how its file is laid out."""
        return hashlib.sha256(self.model_dump_json(exclude_none=True).encode()).hexdigest()


Weighted.model_rebuild()


def parse_faults(text: str | bytes, name: str) -> FaultSpec:
    """Read a fault model from JSON text; BadInput, naming ``name``, if it is not one."""
    try:
        return parse_data(FaultSpec, text)
    except BadInput as error:
        raise BadInput(f"{name}: {error}") from None


def load_faults(path: Path) -> FaultSpec:
    """Read a fault model from a file; BadInput if it is missing or not one."""
    try:
        return parse_faults(path.read_bytes(), str(path))
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror or error}") from None


def fault_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of fault models."""
    schema = FaultSpec.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}

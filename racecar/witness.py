"""Witnesses: a start state and, where an instance has a disturbance, what disturbs the car."""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag

from racecar.data import Data, Number, parse_data


def _choice(value: Any) -> str:
    """Tell by its elements which form a list of missing rays has."""
    nested = isinstance(value, list | tuple) and any(isinstance(x, list | tuple) for x in value)
    return "step" if nested else "run"


class Witness(Data):
    """What a tool claims to be unsafe: a start state (m, m, m/s, rad) and disturbances.

    The lists per step begin at time 0; they may end where the car has been unsafe.
    """

    s: Number
    f: Number
    v: Number
    theta: Number
    missing: (
        Annotated[
            Annotated[list[int], Tag("run")] | Annotated[list[list[int]], Tag("step")],
            Discriminator(_choice),
        ]
        | None
    ) = Field(
        default=None,
        description="indices of missing rays (0: the first), for the whole run or for each step",
    )
    noise: list[list[Number]] | None = Field(
        default=None, description="m, for each step one number per ray; left out: 0"
    )
    mirror: int | None = Field(
        default=None,
        description="index of the segment of the disturbance's mirrors that mirrors for the "
        "whole run (0: the first); left out: none does",
    )

    @property
    def missing_per_step(self) -> bool:
        """Whether the missing rays are given step by step."""
        return any(isinstance(x, list) for x in self.missing or ())

    @property
    def missing_lists(self) -> list[list[int]]:
        """The missing rays as lists: one for each step, or only one; none if none is missing."""
        rows = [x for x in self.missing or () if isinstance(x, list)]
        rays = [x for x in self.missing or () if isinstance(x, int)]
        return rows or ([rays] if rays else [])


def parse_witness(text: str | bytes) -> Witness:
    """Read a witness from JSON; BadInput if that fails."""
    return parse_data(Witness, text)


def format_witness(witness: Witness) -> str:
    """Return the text that stands after ``sat``; every number reads back as the same double."""
    return json.dumps(witness.model_dump(exclude_none=True)) + "\n"

"""Specifications of a network as plain data: boxes of inputs, and what its outputs must not do."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from generator.openloop.numbers import at_least, at_most

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Box:
    """All inputs x with ``lower <= x <= upper``, float32 ``[inputs]`` each."""

    lower: Floats
    upper: Floats

    def __post_init__(self) -> None:
        if self.lower.dtype != np.float32 or self.upper.dtype != np.float32:
            raise ValueError("bounds of a box are float32")
        if self.lower.shape != self.upper.shape or not np.all(self.lower <= self.upper):
            raise ValueError("a box has a lower bound that is not above the upper one everywhere")

    @classmethod
    def inside(cls, lower: list[Fraction], upper: list[Fraction]) -> Box:
        """Return the largest box of float32 bounds inside [lower, upper].

        Raises ValueError if no float32 lies between two of the bounds.
        """
        return cls(
            np.array([at_least(x) for x in lower], dtype=np.float32),
            np.array([at_most(x) for x in upper], dtype=np.float32),
        )


@dataclass(frozen=True)
class OutputBound:
    """``y[index] <= bound`` or ``y[index] >= bound``."""

    index: int
    relation: Literal["<=", ">="]
    bound: np.float32


#: All of these hold.
Conjunction = tuple[OutputBound, ...]


@dataclass(frozen=True)
class Spec:
    """Is there an input in one of the boxes for which one of the conjunctions holds?

    The answer sat is a violation, as in VNN-COMP. title: what is asked, lines of comment;
    boxes: at least one; outputs: how many the network has; unsafe: at least one conjunction.
    """

    title: tuple[str, ...]
    boxes: tuple[Box, ...]
    outputs: int
    unsafe: tuple[Conjunction, ...]

    def __post_init__(self) -> None:
        if not self.boxes or not self.unsafe or not all(self.unsafe):
            raise ValueError("a specification has at least one box and one condition")

    @property
    def inputs(self) -> int:
        """The number of inputs."""
        return len(self.boxes[0].lower)

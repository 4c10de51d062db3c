"""Setups: what a controller's name says about how it was trained.

``TD3_L21_64x64_C1`` is the paper's form: algorithm, LiDAR rays, neurons per hidden layer,
index of the controller (the first, second, ... seed that finished the turn). ROBUST and SMOOTH
are not reinforcement learning: they learn from a teacher (generator.robust).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from generator.hyperparams.robust import STUDENTS
from racecar.errors import BadInput
from racecar.experiment import default_field_of_view

ALGORITHMS = ("DDPG", "TD3", *STUDENTS)
_NAME = re.compile(
    r"(?P<algorithm>[A-Z0-9]+)_L(?P<rays>\d+)_(?P<hidden>\d+(x\d+)*)_C(?P<index>\d+)"
)


@dataclass(frozen=True)
class Setup:
    """One controller to train.

    algorithm: one of ALGORITHMS; rays: of the LiDAR; hidden: neurons per hidden layer; index:
    counts the seeds of a setup that finished the turn, from 1.
    """

    algorithm: str
    rays: int
    hidden: tuple[int, ...]
    index: int

    @property
    def family(self) -> str:
        """The name without the index: what all seeds share."""
        return f"{self.algorithm}_L{self.rays}_{'x'.join(map(str, self.hidden))}"

    @property
    def field_of_view(self) -> float:
        """Of the LiDAR, radians."""
        return default_field_of_view(self.rays)

    @property
    def name(self) -> str:
        """The controller's name."""
        return f"{self.family}_C{self.index}"


def parse_setup(name: str) -> Setup:
    """Read a controller's name; BadInput if it does not follow the form."""
    match = _NAME.fullmatch(name)
    if not match or match["algorithm"] not in ALGORITHMS:
        raise BadInput(
            f"setup {name!r} is unknown; write it like TD3_L21_64x64_C1 "
            f"(algorithm, one of {', '.join(ALGORITHMS)}, rays, hidden layers, index)"
        )
    hidden = tuple(int(x) for x in match["hidden"].split("x"))
    rays, index = int(match["rays"]), int(match["index"])
    if rays < 2 or index < 1 or min(hidden) < 1:
        raise BadInput(f"setup {name!r}: it needs at least 2 rays, 1 neuron per layer and index 1")
    return Setup(match["algorithm"], rays, hidden, index)

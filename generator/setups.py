"""Setups: what a controller's name says about how it was trained.

``TD3_L21_64x64_C1`` is the paper's form: algorithm, LiDAR rays, neurons per hidden layer,
index of the controller (the first, second, ... seed that finished the turn). Beyond the paper,
``64x64relu`` has ReLU instead of tanh in its hidden layers, and ``conv`` reads the scan with
convolutions, whose sizes its hyper-parameter file says. EARLY is TD3 that was stopped early. ROBUST
and SMOOTH are not reinforcement learning: they learn from a teacher (generator.robust).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from generator.hyperparams import AnyHyperparameters, Hyperparameters, load_hyperparameters
from generator.hyperparams.robust import STUDENTS
from racecar.errors import BadInput
from racecar.experiment import default_field_of_view

PAPER_RAYS = (21, 41, 61)
ALGORITHMS = ("DDPG", "TD3", "EARLY", *STUDENTS)
_NAME = re.compile(
    r"(?P<algorithm>[A-Z0-9]+)_L(?P<rays>\d+)_"
    r"(conv|(?P<hidden>\d+(x\d+)*)(?P<relu>relu)?)_C(?P<index>\d+)"
)


@dataclass(frozen=True)
class Setup:
    """One controller to train.

    algorithm: one of ALGORITHMS; rays: of the LiDAR; hidden: neurons per hidden layer, none for
    a convolutional controller; index: counts the seeds of a setup that finished the turn, from
    1; activation: of the hidden layers.
    """

    algorithm: str
    rays: int
    hidden: tuple[int, ...]
    index: int
    activation: Literal["tanh", "relu"] = "tanh"

    @property
    def convolutional(self) -> bool:
        """Whether it reads the scan with convolutions."""
        return not self.hidden

    @property
    def network(self) -> str:
        """What the name says of the network, such as 64x64, 64x64relu or conv."""
        if self.convolutional:
            return "conv"
        activation = "" if self.activation == "tanh" else self.activation
        return "x".join(map(str, self.hidden)) + activation

    @property
    def family(self) -> str:
        """The name without the index: what all seeds share."""
        return f"{self.algorithm}_L{self.rays}_{self.network}"

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
            f"setup {name!r} is unknown; write it like TD3_L21_64x64_C1 (algorithm, one of "
            f"{', '.join(ALGORITHMS)}, rays, hidden layers as 64x64, 64x64relu or conv, index)"
        )
    hidden = tuple(int(x) for x in match["hidden"].split("x")) if match["hidden"] else ()
    rays, index = int(match["rays"]), int(match["index"])
    if rays < 2 or index < 1 or 0 in hidden:
        raise BadInput(f"setup {name!r}: it needs at least 2 rays, 1 neuron per layer and index 1")
    setup = Setup(match["algorithm"], rays, hidden, index, "relu" if match["relu"] else "tanh")
    if setup.algorithm in STUDENTS and (setup.convolutional or setup.activation != "tanh"):
        raise BadInput(f"setup {name!r}: {setup.algorithm} trains tanh layers; write 64x64")
    return setup


def setup_hyperparameters(setup: Setup, own: Path | None = None) -> AnyHyperparameters:
    """Return a setup's hyper-parameters, from the package or a file of one's own.

    BadInput if the package has none for such a setup, or if the file is for other networks
    than the setup's name says.
    """
    parameters = load_hyperparameters(setup.algorithm + _variant(setup), own)
    if not isinstance(parameters, Hyperparameters):
        return parameters
    networks = parameters.policy_kwargs
    if networks.activation != setup.activation:
        raise BadInput(
            f"{own}: policy_kwargs.activation is {networks.activation}, but the name "
            f"{setup.name} says {setup.activation}; make them agree"
        )
    sizes = {"convolutions": networks.convolutions, "hidden": networks.hidden}
    for name, value in sizes.items():
        if setup.convolutional != (value is not None):
            advice = "give it" if setup.convolutional else "leave it out"
            raise BadInput(
                f"{own}: policy_kwargs.{name} is for convolutional setups; "
                f"{advice} for {setup.name}"
            )
    return parameters


def _variant(setup: Setup) -> str:
    """Return which of an algorithm's files is for a setup, as the end of its name."""
    if setup.algorithm in STUDENTS:
        return ""
    if setup.convolutional:
        return "_conv"
    if setup.activation == "relu":
        return "_relu"
    return "_wide_scan" if setup.rays > PAPER_RAYS[-1] else ""

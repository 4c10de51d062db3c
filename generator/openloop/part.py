"""What a category of VNN-LIB questions adds to the emitted tree, for one controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from zlib import crc32

import numpy as np

from generator.instances import ControllerFile
from generator.openloop.printer import VERSIONS, print_spec
from generator.openloop.questions import open_loop_questions
from generator.openloop.spec import Spec
from generator.openloop.views import MIDDLE, UNIT
from generator.tree import Tree
from racecar.closed_loop import Plant

NETWORKS, SPECS = "onnx", "vnnlib"


@dataclass(frozen=True)
class Asked:
    """One instance: its ID, the network's path below the root, and the timeout in seconds."""

    id: str
    network: str
    timeout: int


@dataclass
class Part:
    """Files by path below the root, and the instances in their order."""

    files: Tree = field(default_factory=dict)
    asked: list[Asked] = field(default_factory=list)

    def add(self, category: str, asked: Asked, spec: Spec) -> None:
        """Add an instance with its specification in all versions of VNN-LIB.

        Raises ValueError if there is one with this ID already.
        """
        for version in VERSIONS:
            path = spec_path(category, asked.id, version)
            if path in self.files:
                raise ValueError(f"two instances have the ID {asked.id}")
            self.files[path] = print_spec(spec, version).encode()
        self.asked.append(asked)


@dataclass(frozen=True)
class Draw:
    """Where the nominal drive starts: in the middle of the range, or where a seed says.

    start: s, m; tag: what IDs say about it, with a full stop at its end.
    """

    start: Fraction = MIDDLE
    tag: str = ""

    @classmethod
    def of(cls, seed: int, controller: str) -> Draw:
        """Draw a start from the benchmark's range, another one for every controller."""
        random = np.random.default_rng([seed, crc32(controller.encode())])
        low, high = -(-Fraction("0.65") // UNIT), Fraction("0.85") // UNIT
        return cls(int(random.integers(low, high, endpoint=True)) * UNIT, f"seed{seed}.")


#: (controller, plant, category, timeout in seconds, draw) -> what the category adds.
MakePart = Callable[[ControllerFile, Plant, str, int, Draw], Part]


def spec_path(category: str, id: str, version: str) -> str:
    """Return where the specification of an instance lies below the root."""
    return f"{SPECS}/{category}/{version}/{id}.vnnlib"


def open_loop_part(
    file: ControllerFile, plant: Plant, category: str, timeout: int, draw: Draw
) -> Part:
    """Return the questions about a controller alone."""
    part, network = Part(), f"{NETWORKS}/{file.path.name}"
    questions = open_loop_questions(file.name, file.controller, plant, draw.start, draw.tag)
    for question in questions:
        part.add(category, Asked(question.id, network, timeout), question.spec)
    return part

"""Instances from a controller and a few numbers that a person gave."""

from __future__ import annotations

import hashlib
import json
import math
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from generator.partition import Bounds, exact_decimal
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.controller import Controller, parse_controller
from racecar.disturbance import Disturbance
from racecar.instance import Instance, parse_instance, plant_data, property_data, read_text
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import square_track

#: What the paper's largest controllers have. Files of larger ones that spell out weights would be
#: megabytes each; `generator export` makes them.
MOST_WEIGHTS, MOST_RAYS = 25_000, 61
#: One value, or lower and upper bound, as decimal literals.
Range = str | Bounds


@dataclass(frozen=True)
class Question:
    """What an instance asks of a controller on the paper's track.

    start: of s (m); front, speed: of f (m) and v (m/s); heading: degrees, counter-clockwise;
    numbers are decimal literals; steps: control periods; safety: name of the property;
    disturbance: of the LiDAR, if any.
    """

    id: str
    category: str
    start: Range
    front: Range = "9.9"
    speed: Range = "0"
    heading: Range = "0"
    steps: int = 70
    safety: str = "clearance"
    disturbance: Disturbance | None = None


@dataclass(frozen=True)
class ControllerFile:
    """A controller and the file that it came from."""

    path: Path
    content: bytes
    controller: Controller

    @classmethod
    def load(cls, path: Path) -> ControllerFile:
        """Read a file; BadInput if it is not a controller."""
        content = read_text(path)
        return cls(path, content, parse_controller(content, str(path)))

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem

    @property
    def small(self) -> bool:
        """Whether it is no larger than the paper's: in weights and in rays."""
        return self.weights <= MOST_WEIGHTS and self.controller.rays <= MOST_RAYS

    @property
    def like_the_papers(self) -> bool:
        """Whether it is small and has at most two hidden layers, of tanh neurons only."""
        hidden = [layer for layer in self.controller.layers if len(layer.biases) > 1]
        tanh = all(layer.activation == "tanh" for layer in hidden)
        return self.small and len(hidden) <= 2 and tanh

    @property
    def weights(self) -> int:
        """How many weights its layers have, biases left out; a convolution counts as its matrix."""
        return sum(layer.weights.size for layer in self.controller.layers)

    @property
    def parameters(self) -> int:
        """How many numbers the file holds for its layers: weights or kernels, and biases."""
        return sum(
            layer.weights.size + layer.biases.size
            if (own := layer.convolution) is None
            else own.kernels.size + own.biases.size
            for layer in self.controller.layers
        )

    @property
    def further_seed(self) -> bool:
        """Whether the name says that it is not the first of its setup, such as ..._C2."""
        index = self.name.rpartition("_C")[2]
        return index.isdecimal() and int(index) != 1

    @property
    def sha256(self) -> str:
        """Of the file."""
        return hashlib.sha256(self.content).hexdigest()


def make_instance(
    question: Question, file: ControllerFile, field_of_view: float, target: Path
) -> Instance:
    """Return the instance that is to lie at ``target``.

    field_of_view: radians. Raises BadInput, naming ``target``, if it would not be valid.
    """
    s, f, v = (_bounds(x) for x in (question.start, question.front, question.speed))
    theta = [math.radians(x) for x in _bounds(question.heading)]
    data = {
        "id": question.id,
        "category": question.category,
        "controller": {
            "name": file.name,
            "file": _relative(file.path, target),
            "sha256": file.sha256,
        },
        "plant": _plant(file.controller.rays, field_of_view),
        "initial_set": {"s": s, "f": f, "v": v, "theta": theta},
        "steps": question.steps,
        "property": _property(question.safety),
    }
    if question.disturbance is not None:
        data["disturbance"] = question.disturbance.model_dump(mode="json")
    return parse_instance(json.dumps(data), str(target))


def _bounds(given: Range) -> list[float]:
    """Return lower and upper bound as doubles."""
    low, high = (given, given) if isinstance(given, str) else given
    return [float(exact_decimal(x)) for x in (low, high)]


def benchmark_plant(rays: int, field_of_view: float) -> Plant:
    """Return the paper's track and car with a LiDAR of so many rays over so many radians."""
    return Plant(square_track(), Bicycle(), Lidar(rays, field_of_view))


@cache
def _plant(rays: int, field_of_view: float) -> dict[str, Any]:
    return plant_data(benchmark_plant(rays, field_of_view)).model_dump(mode="json")


@cache
def _property(name: str) -> dict[str, Any]:
    return property_data(named_property(name, square_track())).model_dump(mode="json")


def _relative(path: Path, target: Path) -> str:
    """Return the way from the folder of ``target`` to ``path``, with forward slashes."""
    folder, start = path.parent.resolve(), target.parent.resolve()
    return Path(os.path.relpath(folder / path.name, start)).as_posix()

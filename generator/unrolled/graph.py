"""Unrolling: the steps of the closed loop, one after another, in one graph.

What the car sees is left to the caller: the general graph and the graphs of one wall pattern
differ in nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import onnx
from numpy.typing import DTypeLike

from generator.unrolled.geometry import Area, StartBox, deciding, step_distances
from generator.unrolled.step import Pose, drive, margin, plant_series, pose, readings, steering
from generator.unrolled.tape import Tape
from racecar.closed_loop import Plant
from racecar.controller import Controller
from racecar.safety import Property

START, OUTPUT = "start", "margins"


@dataclass(frozen=True)
class Seen:
    """What a car sees at a control instant.

    hits: names of the inverse distances to walls, ``[batch, rays]`` each; area: where the car
    can be for this to be right; values: names of further outputs, ``[batch, 1]`` each, as many
    at every instant.
    """

    hits: list[str]
    area: Area
    values: tuple[str, ...] = ()


#: (tape, pose, control instant, where the car can be) -> what it sees.
See = Callable[[Tape, Pose, int, Area], Seen]


@dataclass(frozen=True)
class Task:
    """What is unrolled: the closed loop, its property, the starts (all in ``start``), the steps."""

    controller: Controller
    plant: Plant
    safety: Property
    start: StartBox
    steps: int


def unroll(
    task: Task, see: See, dtype: DTypeLike = np.float32, metadata: Mapping[str, str] | None = None
) -> onnx.ModelProto:
    """Return the network from a start (s, f, v, theta) to the margin (m) after each step.

    Further values that ``see`` gives follow the margins: the first of every instant, then the
    second of every instant, and so on. The graph
    stays in the frame of the first hall, in which all walls are described: no frame changes.
    Raises BadInput for a car with slip and for a controller of unbounded steering.
    """
    tape, plant = Tape(dtype), task.plant
    slope, shift = step_distances(plant.bicycle, plant.period, task.steps)
    longest = slope * task.start.upper[2] + shift
    series = plant_series(plant, task.controller, float(longest.max()))
    nothing = tape.constant(np.zeros((4, plant.lidar.rays)), "nothing")
    zeros = tape.apply("MatMul", START, nothing, name="zeros")
    ones = tape.affine(zeros, 1.0, 1.0, "ones")
    rows = zip(("s", "f", "v", "theta"), np.eye(4), strict=True)
    s, f, v, theta = (tape.column(START, row, f"{START}.{name}") for name, row in rows)
    at = pose(tape, s, f, theta)
    area = Area(task.start.lower[:2], task.start.upper[:2])
    margins: list[str] = []
    values: list[tuple[str, ...]] = []
    for i in range(task.steps):
        tape.prefix = f"{i}."
        seen = see(tape, at, i, area)
        values.append(seen.values)
        scan = readings(tape, plant.lidar, seen.hits, ones)
        delta = steering(tape, task.controller, scan)
        distance = tape.affine(v, float(slope[i]), float(shift[i]), "d")
        at = drive(tape, plant, at, delta, distance, series)
        tape.declare(scan, plant.lidar.rays)
        for x in (at.s, at.f, at.theta):
            tape.declare(x, 1)
        area = seen.area.grown(float(longest[i]))
        margins.append(margin(tape, at, deciding(task.safety.unsafe[0], area)))
    tape.prefix = ""
    outputs = [*margins, *(x for column in zip(*values, strict=True) for x in column)]
    output = tape.apply("Concat", *outputs, name=OUTPUT, axis=1)
    return tape.model(START, 4, output, len(outputs), metadata or {})

"""The nominal drive: the benchmark's start range, no faults, seven seconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State, simulate
from racecar.controller import Controller
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import square_track

STARTS, STEPS = 201, 70


@dataclass(frozen=True)
class Nominal:
    """How a controller drives from all over the start range.

    safe_fraction, margin (m): continuous time, property ``clearance``; finishes_turn: whether
    the car started in the middle of the range reaches the next hall without a crash;
    smoothness: mean absolute change of the steering from step to step, radians.
    """

    safe_fraction: float
    margin: float
    finishes_turn: bool
    smoothness: float

    @property
    def label(self) -> Literal["safe", "unsafe"]:
        """Whether every start kept clear of the walls at all times: "safe" or "unsafe"."""
        return "safe" if self.safe_fraction == 1.0 else "unsafe"


def drive_nominal(controller: Controller, field_of_view: float) -> Nominal:
    """Simulate a controller from an odd number of starts across [0.65, 0.85] m.

    field_of_view: of its LiDAR, radians.
    """
    plant = Plant(square_track(), Bicycle(), Lidar(controller.rays, field_of_view))
    safety = named_property("clearance", plant.track)
    start = State.start(np.linspace(0.65, 0.85, STARTS))
    runs = simulate(plant, controller.steering_rows, safety, start, STEPS, record=True)
    assert runs.trace is not None
    middle = STARTS // 2
    steering = runs.trace["steering"]
    return Nominal(
        safe_fraction=float(np.mean(runs.margin > 0)),
        margin=float(runs.margin.min()),
        finishes_turn=bool(runs.crash_step[middle] < 0 and runs.trace["frame"][middle, -1] > 0),
        smoothness=float(np.nanmean(np.abs(np.diff(steering, axis=1)))),
    )

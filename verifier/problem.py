"""What the verifier works on: an instance and its controller, ready for use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from racecar.closed_loop import Plant
from racecar.controller import Controller
from racecar.instance import Instance, load_instance, load_instance_controller
from racecar.safety import Property
from verifier.models import TERMS, Array, Models
from verifier.rounding import UP, U
from verifier.rows import THETA, F, Rows, S, V


@dataclass(frozen=True)
class Problem:
    """One question, as racecar's objects."""

    plant: Plant
    controller: Controller
    safety: Property
    steps: int
    lower: Array  # [4]: s, f, v, theta
    upper: Array

    @property
    def active(self) -> list[int]:
        """The state components that can be uncertain; the speed only if it is at the start."""
        return [S, F, V, THETA] if self.upper[V] > self.lower[V] else [S, F, THETA]


def load_problem(path: Path) -> tuple[Instance, Problem]:
    """Read an instance and its controller."""
    instance = load_instance(path)
    controller = load_instance_controller(instance, path)
    lower, upper = instance.initial_set.bounds()
    problem = Problem(
        instance.make_plant(), controller, instance.make_property(), instance.steps, lower, upper
    )
    return instance, problem


@dataclass(frozen=True)
class Box:
    """A box of start states; x runs along its ``lead`` component."""

    lower: Array  # [4]
    upper: Array  # [4]
    lead: int

    def halves(self, component: int) -> tuple[Box, Box]:
        """Return the two halves along a component."""
        middle = (self.lower[component] + self.upper[component]) / 2
        first, second = self.upper.copy(), self.lower.copy()
        first[component] = second[component] = middle
        return Box(self.lower, first, self.lead), Box(second, self.upper, self.lead)


def start_rows(box: Box, active: list[int], low: Array, high: Array) -> Rows:
    """Return rows for the pieces [low, high] (``[rows]``, within [-1, 1]) of a box."""
    count = len(low)
    middle = (box.lower + box.upper) / 2
    # Rounded up, so that middle +- half covers the box.
    half = (box.upper - box.lower) / 2 * UP + 2 * U * np.abs(middle)
    half = np.where(box.upper > box.lower, half, 0.0)
    c = np.zeros((TERMS + 2 * len(active), 4, count))
    c[0] = middle[:, None]
    c[1, box.lead] = half[box.lead]
    for i, component in enumerate(active):
        if component != box.lead:
            c[TERMS + 2 * i, component] = half[component]
    rows = Rows(
        state=Models(c, np.zeros((4, count))),
        frame=np.zeros(count, dtype=np.intp),
        low=np.full(count, -1.0),
        high=np.full(count, 1.0),
        least=np.full(count, np.inf),
        decisions=((),) * count,
        kink=np.zeros(count),
        tried=np.full(count, np.inf),
    )
    return rows.restrict(np.asarray(low), np.asarray(high))

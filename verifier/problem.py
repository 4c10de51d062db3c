"""What the verifier works on: an instance and its controller, ready for use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from racecar.closed_loop import Plant
from racecar.controller import Controller
from racecar.instance import Disturbance, Instance, load_instance, load_instance_controller
from racecar.safety import Property
from verifier.models import TERMS, Array, Models
from verifier.rounding import UP, U
from verifier.rows import THETA, F, Rows, S, V, fresh


@dataclass(frozen=True)
class Problem:
    """One question, as racecar's objects."""

    plant: Plant
    controller: Controller
    safety: Property
    steps: int
    lower: Array  # [4]: s, f, v, theta
    upper: Array
    disturbance: Disturbance | None = None

    @property
    def wide(self) -> bool:
        """Whether more than one number is uncertain."""
        return self.noisy or int((self.upper > self.lower).sum()) > 1

    @property
    def noisy(self) -> bool:
        """Whether something uncertain is added at every step."""
        return self.disturbance is not None and (
            self.disturbance.noise > 0 or self.disturbance.choice == "step"
        )


def load_problem(path: Path) -> tuple[Instance, Problem]:
    """Read an instance and its controller."""
    instance = load_instance(path)
    controller = load_instance_controller(instance, path)
    lower, upper = instance.initial_set.bounds()
    problem = Problem(
        instance.make_plant(),
        controller,
        instance.make_property(),
        instance.steps,
        lower,
        upper,
        instance.disturbance,
    )
    return instance, problem


#: The components whose errors are gathered between steps; the speed's do not grow.
ACTIVE = (S, F, THETA)


@dataclass(frozen=True)
class Box:
    """A box of start states; x runs along its ``lead`` component."""

    lower: Array  # [4]
    upper: Array  # [4]
    lead: int

    @property
    def others(self) -> list[int]:
        """The other uncertain components: each is an error symbol, kept to the end."""
        return [i for i in (S, F, V, THETA) if i != self.lead and self.upper[i] > self.lower[i]]


def start_rows(box: Box, low: Array, high: Array, case: int = 0, carried: int = 0) -> Rows:
    """Return rows for the pieces [low, high] (``[rows]``, within [-1, 1]) of a box.

    carried: error symbols for the other components of the box, at least as many as they are.
    """
    count = len(low)
    middle = (box.lower + box.upper) / 2
    # Rounded up, so that middle +- half covers the box.
    half = (box.upper - box.lower) / 2 * UP + 2 * U * np.abs(middle)
    half = np.where(box.upper > box.lower, half, 0.0)
    c = np.zeros((TERMS + 2 * (max(carried, len(box.others)) + len(ACTIVE)), 4, count))
    c[0] = middle[:, None]
    c[1, box.lead] = half[box.lead]
    for i, component in enumerate(box.others):
        c[TERMS + 2 * i, component] = half[component]
    rows = fresh(
        Models(c, np.zeros((4, count))),
        frame=np.zeros(count, dtype=np.intp),
        low=np.full(count, -1.0),
        high=np.full(count, 1.0),
        least=np.full(count, np.inf),
        case=np.full(count, case),
        gathered=False,
    )
    return rows.restrict(np.asarray(low), np.asarray(high))

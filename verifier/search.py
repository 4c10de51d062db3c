"""A search for the worst attack: what is searched, and how much of the search is left."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import State, Steer, simulate
from racecar.disturbance import Disturbance
from verifier.attack import Attacks, Pushed
from verifier.models import Array
from verifier.problem import Problem

#: Larger (m) than every margin, and finite, so that differences can be taken.
NOT_A_RUN = 1e9


@dataclass(eq=False)
class Search:
    """What is searched, and how much of the search is left.

    lower, upper: start box ``[4]``; runs: still to be simulated; deadline: of time.monotonic;
    again: whether a search that is stuck begins anew as long as it may.
    """

    problem: Problem
    steer: Steer
    lower: Array
    upper: Array
    random: np.random.Generator
    runs: int
    deadline: float = np.inf
    again: bool = False

    @property
    def over(self) -> bool:
        """Whether the budget is used up."""
        return self.runs <= 0 or time.monotonic() > self.deadline

    @property
    def given(self) -> Disturbance:
        """The disturbance."""
        given = self.problem.disturbance
        if given is None:
            raise ValueError("the problem has no disturbance")
        return given

    @property
    def pushed(self) -> bool:
        """Whether pushes have an effect."""
        return self.given.noise > 0 or self.picks

    @property
    def mirrors(self) -> NDArray[np.intp]:
        """What may mirror: no wall (-1), or one of the segments."""
        given = self.given.mirrors
        return np.arange(-1, 0 if given is None else len(given.segments))

    @property
    def picks(self) -> bool:
        """Whether pushes choose rays."""
        return self.given.missing > 0 and self.given.choice == "step"

    def margins(self, attacks: Attacks) -> Array:
        """Return the margins (m) of attacks; NOT_A_RUN where the network answers NaN."""
        self.runs -= len(attacks)
        with np.errstate(invalid="ignore", over="ignore"):
            runs = simulate(
                self.problem.plant,
                self.steer,
                self.problem.safety,
                State.start(*attacks.start.T),
                self.problem.steps,
                Pushed(self.problem, attacks),
            )
        return np.where(np.isnan(runs.margin), NOT_A_RUN, runs.margin)

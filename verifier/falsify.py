"""Looking for a start state that is unsafe, by simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from racecar.closed_loop import State, Steer, simulate
from verifier.models import Array
from verifier.problem import Problem

#: Starts simulated at first, and around the worst of them in each round of refinement.
STARTS, ROUND, ROUNDS = 512, 64, 4


@dataclass(frozen=True)
class Worst:
    """The worst start found: state ``[4]`` (s, f, v, theta) and its margin (m)."""

    start: Array
    margin: float


def worst_start(problem: Problem, steer: Steer, lower: Array, upper: Array, seed: int = 0) -> Worst:
    """Search the box [lower, upper] for the start with the least margin; seeded."""
    random = np.random.default_rng(seed)
    free = np.flatnonzero(upper > lower)
    starts = np.tile(lower, (STARTS, 1))
    if len(free) == 1:
        starts[:, free[0]] = np.linspace(lower[free[0]], upper[free[0]], STARTS)
    elif len(free):
        starts[:, free] = random.uniform(lower[free], upper[free], (STARTS, len(free)))
        corners = np.array(np.meshgrid(*([[0, 1]] * len(free)))).reshape(len(free), -1).T
        starts[: len(corners), free] = np.where(corners, upper[free], lower[free])
    best = _best(problem, steer, starts)
    width = (upper - lower) / (STARTS if len(free) == 1 else 4)
    for _ in range(ROUNDS if len(free) else 0):
        if best.margin <= 0:
            break
        near = best.start + random.uniform(-1, 1, (ROUND, 4)) * width
        found = _best(problem, steer, np.clip(near, lower, upper))
        best = min(best, found, key=lambda w: w.margin)
        width = width / 4
    return best


def confirmed(problem: Problem, steer: Steer, start: Array) -> bool:
    """Tell whether a start, simulated by itself, is unsafe."""
    return _best(problem, steer, start[None]).margin <= 0


def _best(problem: Problem, steer: Steer, starts: Array) -> Worst:
    state = State.start(*starts.T)
    runs = simulate(problem.plant, steer, problem.safety, state, problem.steps)
    worst = int(runs.margin.argmin())
    return Worst(starts[worst], float(runs.margin[worst]))

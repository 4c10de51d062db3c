"""Looking for a run that is unsafe, by simulation: its start, and what disturbs it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from racecar.closed_loop import State, Steer, simulate
from racecar.faults import GivenFaults
from verifier.adversary import worst_attacks
from verifier.attack import Attacks, Mask, Pushed, mirrors_of
from verifier.models import Array
from verifier.problem import Problem
from verifier.rows import THETA, F, S, V
from verifier.search import Search
from verifier.starts import lowest_start

_STATE = {"s": S, "f": F, "v": V, "theta": THETA}
#: Runs simulated, at most about this many, in search of a disturbance.
RUNS = 16384
#: Of the attacks found so many are tried one by one, if the margin of the worst is CLOSE (m) to 0.
MOST_STATED, CLOSE = 4, 1e-3


@dataclass(frozen=True)
class Worst:
    """The worst run found: its start ``[4]`` (s, f, v, theta) and its margin (m).

    missing: which rays are missing, ``[rays]`` or ``[steps, rays]``; noise: ``[steps, rays]``,
    metres; None: none. Both go on as long as the run, which ends at a crash. mirror: index of the
    segment that mirrors; None: none does.
    """

    start: Array
    margin: float
    missing: Mask | None = None
    noise: Array | None = None
    mirror: int | None = None

    def witness(self) -> dict[str, Any]:
        """Return the witness as plain data, as the harness reads it after ``sat``."""
        data: dict[str, Any] = {name: float(self.start[i]) for name, i in _STATE.items()}
        if self.missing is not None and self.missing.ndim == 1:
            data["missing"] = np.flatnonzero(self.missing).tolist()
        elif self.missing is not None:
            data["missing"] = [np.flatnonzero(row).tolist() for row in self.missing]
        if self.noise is not None:
            data["noise"] = self.noise.tolist()
        if self.mirror is not None:
            data["mirror"] = self.mirror
        return data


def worst_start(
    problem: Problem,
    steer: Steer,
    lower: Array,
    upper: Array,
    seed: int = 0,
    runs: int = RUNS,
    seconds: float = np.inf,
    again: bool = False,
) -> Worst:
    """Search for the run of the least margin that starts in the box [lower, upper]; seeded.

    runs, seconds: bounds on the search for disturbances, kept roughly; again: whether it uses
    them up, and begins anew where it is stuck.
    """
    random = np.random.default_rng(seed)
    if problem.disturbance is None:
        start, margin = lowest_start(lambda x: _margins(problem, steer, x), lower, upper, random)
        # By itself a run is not quite what it is in a batch, where sums go in another order.
        return Worst(start, margin if margin > 0 else _replayed(problem, steer, start)[0])
    deadline = time.monotonic() + seconds
    search = Search(problem, steer, lower, upper, random, runs, deadline, again)
    attacks = worst_attacks(search)
    worst = stated(problem, steer, attacks.take(slice(1)))
    for i in range(1, min(len(attacks), MOST_STATED)):
        # Here, too: the next ones may be unsafe by themselves where the worst is not.
        if worst.margin <= 0 or worst.margin > CLOSE:
            break
        other = stated(problem, steer, attacks.take(slice(i, i + 1)))
        worst = min(worst, other, key=lambda x: x.margin)
    return worst


def confirmed(problem: Problem, steer: Steer, worst: Worst | Array) -> bool:
    """Tell whether a run, simulated by itself from its start and disturbances, is unsafe."""
    return _replayed(problem, steer, worst)[0] <= 0


def stated(problem: Problem, steer: Steer, attack: Attacks) -> Worst:
    """Return a single attack value by value, and the margin of the run that the values give."""
    given, steps = problem.disturbance, problem.steps
    pushed = Pushed(problem, attack, keep=True)
    _margins(problem, steer, attack.start, pushed)
    rays = problem.plant.lidar.rays
    noise, gone = np.zeros((steps, rays)), np.zeros((steps, rays), dtype=bool)
    for step, (row, missing) in enumerate(zip(pushed.noise, pushed.gone, strict=True)):
        noise[step], gone[step] = row[:, 0] + 0.0, missing[:, 0]  # no -0.0
    if given is not None and given.choice == "run":
        gone = attack.gone[0] & gone.any()
    # A mirror that no ray meets is none.
    mirror = int(attack.mirror[0]) if any(lost.any() for lost in pushed.lost) else None
    worst = Worst(attack.start[0], np.nan, gone, noise, mirror)
    margin, driven = _replayed(problem, steer, worst)
    return Worst(
        worst.start,
        margin,
        (gone if gone.ndim == 1 else gone[:driven]) if gone.any() else None,
        noise[:driven] if noise[:driven].any() else None,
        mirror,
    )


def _replayed(problem: Problem, steer: Steer, worst: Worst | Array) -> tuple[float, int]:
    """Return the margin of a run (or of an undisturbed start), and how many steps it lasts."""
    if not isinstance(worst, Worst):
        worst = Worst(worst, np.nan)
    disturb, steps = None, problem.steps
    if problem.disturbance is not None:
        plant = problem.plant
        disturb = GivenFaults(
            plant.track.width,
            plant.lidar.range,
            None if worst.missing is None else worst.missing[..., None],
            problem.disturbance.turn_only,
            None if worst.noise is None else worst.noise[..., None],
            None if worst.mirror is None else mirrors_of(problem, worst.mirror),
        )
        if worst.noise is not None:
            steps = min(steps, len(worst.noise))
        if worst.missing is not None and worst.missing.ndim == 2:
            steps = min(steps, len(worst.missing))
    state = State.start(*worst.start)
    with np.errstate(invalid="ignore", over="ignore"):
        runs = simulate(problem.plant, steer, problem.safety, state, steps, disturb)
    crash = int(runs.crash_step[0])
    margin = float(runs.margin[0])
    return np.inf if np.isnan(margin) else margin, crash if crash > 0 else steps


def _margins(problem: Problem, steer: Steer, starts: Array, disturb: Pushed | None = None) -> Array:
    """Return the margin of each start, ``[batch, 4]``; infinite where the network answers NaN."""
    state = State.start(*starts.T)
    with np.errstate(invalid="ignore", over="ignore"):
        runs = simulate(problem.plant, steer, problem.safety, state, problem.steps, disturb)
    return np.where(np.isnan(runs.margin), np.inf, runs.margin)

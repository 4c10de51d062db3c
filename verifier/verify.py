"""Deciding an instance: look for an unsafe start, else prove that there is none."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from racecar.closed_loop import State, Steer, simulate
from verifier.disturbed import MirrorsUnknown, TooManyChoices, cases
from verifier.falsify import Worst, confirmed, worst_start
from verifier.forever import Forever, prove_forever
from verifier.models import Array
from verifier.piece import Outcome, Piece
from verifier.pieces import divided, prove_pieces
from verifier.problem import Box, Problem
from verifier.record import Record, joined
from verifier.result import Result
from verifier.rows import S

#: The falsifier's first search may take this share of the time, and no more seconds than this.
SEARCH_SHARE, SEARCH_MOST = 0.2, 30.0
#: Runs of more control periods than this are proved safe for ever, if that succeeds; the
#: falsifier looks at no more of them.
LONG = 1000
#: What is said of an instance with mirrors that is not sat.
MIRRORS = "a wall may mirror: a witness is searched for, but nothing can be proved yet"
#: Open pieces that are searched for a witness.
MOST_SEARCHED = 64


def verify(
    problem: Problem, steer: Steer, timeout: float = np.inf,
    report: Callable[[float], None] = lambda share: None, workers: int = 1,
) -> Result:  # fmt: skip
    """Decide a problem within ``timeout`` seconds; ``report`` gets the share decided."""
    return verify_recorded(problem, steer, timeout, report, workers, recorded=False)[0]


def verify_recorded(
    problem: Problem,
    steer: Steer,
    timeout: float = np.inf,
    report: Callable[[float], None] = lambda share: None,
    workers: int = 1,
    recorded: bool = True,
) -> tuple[Result, Record | None]:
    """Decide a problem; with it, if it is unsat and ``recorded``, the record of the proof."""
    began = time.monotonic()
    deadline = began + timeout
    searched = replace(problem, steps=min(problem.steps, LONG))
    seconds = min(SEARCH_SHARE * timeout, SEARCH_MOST)
    worst = worst_start(searched, steer, problem.lower, problem.upper, seconds=seconds)
    box = Box(problem.lower, problem.upper, lead(searched, steer))
    outcomes: list[Outcome] = []
    pieces: list[Piece] = []
    note = ""
    if not (worst.margin <= 0 and confirmed(problem, steer, worst)):
        try:
            if problem.steps > LONG:
                circle = prove_forever(problem, box, worst.margin, deadline, report)
                if circle.proved:
                    return _proved_forever(circle, worst, began), None
                note = circle.note
            pieces = divided(len(cases(problem.disturbance, problem.plant.lidar.rays)), workers)
            for outcome in prove_pieces(
                problem, box, pieces, worst.margin, deadline, recorded, workers, report
            ):
                outcomes.append(outcome)
            worst = _search_open(searched, steer, box, outcomes, worst, deadline)
        except TooManyChoices:
            note = "there are more choices of missing rays than can be tried"
        except MirrorsUnknown:
            note = MIRRORS
        if not all(o.in_time for o in outcomes):
            note = "the time limit was reached"
    unsafe = worst.margin <= 0 and confirmed(problem, steer, worst)
    proved = 0 < len(outcomes) == len(pieces) and all(
        o.in_time and not o.low.size for o in outcomes
    )
    verdict = "sat" if unsafe else "unsat" if proved else "unknown"
    decided = sum(o.decided for o in outcomes) / len(pieces) if outcomes else 0.0
    result = Result(
        verdict=verdict,
        margin_lower=min(o.least for o in outcomes) if verdict == "unsat" else None,
        margin_upper=worst.margin,
        decided=1.0 if verdict != "unknown" else decided,
        leaves=sum(o.leaves for o in outcomes),
        paths=1 + sum(o.cuts for o in outcomes),
        time_s=time.monotonic() - began,
        witness=worst.witness() if unsafe else None,
        note=note,
        network_time_s=sum(o.network_time_s for o in outcomes),
    )
    records = [o.record for o in outcomes if o.record is not None]
    return result, joined(records) if verdict == "unsat" and records else None


def _proved_forever(circle: Forever, worst: Worst, began: float) -> Result:
    return Result(
        verdict="unsat",
        margin_lower=circle.least,
        margin_upper=worst.margin,
        decided=1.0,
        leaves=circle.leaves,
        paths=1 + circle.cuts,
        time_s=time.monotonic() - began,
        witness=None,
        note=f"safe for ever: the states at corner {len(circle.corners) + 1} are among those of "
        f"corner {circle.returns + 1}",
    )


def _search_open(
    problem: Problem, steer: Steer, box: Box, outcomes: list[Outcome], worst: Worst, deadline: float
) -> Worst:
    """Look for a witness in what the proof left open, the widest pieces first."""
    pieces = [
        (high - low, *_start_box(box, low, high))
        for outcome in outcomes
        for low, high in zip(outcome.low, outcome.high, strict=True)
    ]
    pieces.sort(key=lambda piece: -piece[0])
    for _, lower, upper in pieces[:MOST_SEARCHED]:
        if worst.margin <= 0 or time.monotonic() > deadline:
            break
        left = max(0.0, deadline - time.monotonic())
        found = worst_start(problem, steer, lower, upper, seconds=left)
        worst = min(worst, found, key=lambda w: w.margin)
    return worst


def _start_box(box: Box, low: float, high: float) -> tuple[Array, Array]:
    """Return the part [low, high] of a box along its lead component."""
    middle, half = (box.lower + box.upper) / 2, (box.upper - box.lower) / 2
    lower, upper, i = box.lower.copy(), box.upper.copy(), box.lead
    lower[i] = max(box.lower[i], middle[i] + low * half[i])
    upper[i] = min(box.upper[i], middle[i] + high * half[i])
    return lower, upper


def lead(problem: Problem, steer: Steer) -> int:
    """Return the start component that x is to run along: the one that moves the car most.

    Its effect is taken after the first second: others may die away until the turn.
    """
    free = np.flatnonzero(problem.upper > problem.lower)
    if len(free) < 2:
        return int(free[0]) if len(free) else S
    middle = (problem.lower + problem.upper) / 2
    ends = np.tile(middle, (2 * len(free), 1))
    for i, component in enumerate(free):
        ends[2 * i, component] = problem.lower[component]
        ends[2 * i + 1, component] = problem.upper[component]
    state = State.start(*ends.T)
    runs = simulate(problem.plant, steer, problem.safety, state, problem.steps, record=True)
    assert runs.trace is not None
    later = slice(min(10, problem.steps), None)
    traces = np.stack([runs.trace[name][:, later] for name in ("s", "f", "theta")], axis=1)
    moved = np.abs(traces[1::2] - traces[::2]).max(axis=(1, 2))
    return int(free[np.nan_to_num(moved).argmax()])

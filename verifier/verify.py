"""Deciding an instance: look for an unsafe start, else prove that there is none."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from racecar.closed_loop import Steer
from verifier.falsify import confirmed, worst_start
from verifier.models import Array
from verifier.problem import Box, Problem
from verifier.proof import OutOfTime, Prover
from verifier.result import Result
from verifier.rows import THETA, F, S, V

#: Errors (m, rad) allowed per step, tried in turn on what the one before left open.
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
#: A box is given up rather than split into more pieces than this (along its other axes).
MOST_BOXES = 4096
_STATE = {"s": S, "f": F, "v": V, "theta": THETA}


@dataclass
class _Tally:
    """What has been decided so far: shares of the start set, and the proof's figures.

    decided: share proved in boxes that are done with; current: in the box at hand.
    """

    decided: float = 0.0
    current: float = 0.0
    least: float = np.inf
    leaves: int = 0
    paths: int = 1
    complete: bool = False  # whether every box was treated to its end
    open: list[tuple[Array, Array]] = field(default_factory=list)


def verify(
    problem: Problem, steer: Steer, timeout: float = np.inf,
    report: Callable[[float], None] = lambda share: None,
) -> Result:  # fmt: skip
    """Decide a problem within ``timeout`` seconds; ``report`` gets the share decided."""
    began = time.perf_counter()
    deadline = began + timeout

    def check() -> None:
        if time.perf_counter() > deadline:
            raise OutOfTime

    worst = worst_start(problem, steer, problem.lower, problem.upper)
    tally, note = _Tally(), ""
    if not (worst.margin <= 0 and confirmed(problem, steer, worst.start)):
        try:
            _prove(problem, worst.margin, check, tally, report)
            for low, high in tally.open:
                check()
                found = worst_start(problem, steer, low, high)
                worst = min(worst, found, key=lambda w: w.margin)
                if worst.margin <= 0:
                    break
        except OutOfTime:
            note = "the time limit was reached"
    unsafe = worst.margin <= 0 and confirmed(problem, steer, worst.start)
    proved = tally.complete and not tally.open
    verdict = "sat" if unsafe else "unsat" if proved else "unknown"
    return Result(
        verdict=verdict,
        margin_lower=tally.least if verdict == "unsat" else None,
        margin_upper=worst.margin,
        decided=1.0 if unsafe else tally.decided + tally.current,
        leaves=tally.leaves,
        paths=tally.paths,
        time_s=time.perf_counter() - began,
        witness={n: float(worst.start[i]) for n, i in _STATE.items()} if unsafe else None,
        note=note,
    )


def _prove(
    problem: Problem, wanted: float, check: Callable[[], None], tally: _Tally,
    report: Callable[[float], None],
) -> None:  # fmt: skip
    """Prove box after box; what stays open is split along its widest other axis."""
    prover = Prover(problem, wanted, check)
    whole = Box(problem.lower, problem.upper, int(np.argmax(problem.upper - problem.lower)))
    boxes = [(whole, 1.0)]
    opened = 1
    while boxes:
        box, share = boxes.pop()
        low, high = _prove_box(prover, box, share, tally, report)
        tally.current = 0.0
        if not low.size:
            tally.decided += share
            report(tally.decided)
            continue
        widths = box.upper - box.lower
        widths[box.lead] = 0
        if widths.max() > 0 and opened < MOST_BOXES:
            opened += 1
            boxes += [(half, share / 2) for half in box.halves(int(widths.argmax()))]
            continue
        tally.decided += share * (1 - float(np.sum(high - low)) / 2)
        tally.open += _pieces(box, low, high)
    tally.complete = True
    if not tally.open:
        tally.decided = 1.0


def _prove_box(
    prover: Prover, box: Box, share: float, tally: _Tally, report: Callable[[float], None]
) -> tuple[Array, Array]:
    """Return the pieces (within [-1, 1]) of a box that stay open at every tolerance."""
    low, high = np.array([-1.0]), np.array([1.0])
    for tolerance in TOLERANCES:
        proof = prover.prove(box, low, high, tolerance)
        tally.least = min(tally.least, proof.least)
        tally.leaves += proof.leaves
        tally.paths = 1 + prover.cuts
        low, high = merged(proof.low, proof.high)
        tally.current = share * (1 - float(np.sum(high - low)) / 2)
        report(tally.decided + tally.current)
        if not low.size:
            break
    return low, high


#: The ends of a row's piece are tracked to within this (in the box's units, -1 to 1).
_TRACKED = 2e-12


def merged(low: Array, high: Array) -> tuple[Array, Array]:
    """Return intervals within [-1, 1] that cover the given pieces, joined where they touch.

    They are a little wider, so that they cover the pieces as the models mean them, too.
    """
    low, high = np.maximum(low - _TRACKED, -1.0), np.minimum(high + _TRACKED, 1.0)
    order = np.argsort(low)
    joined: list[list[float]] = []
    for a, b in zip(low[order], high[order], strict=True):
        if joined and a <= joined[-1][1]:
            joined[-1][1] = max(joined[-1][1], b)
        else:
            joined.append([a, b])
    pairs = np.array(joined).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _pieces(box: Box, low: Array, high: Array) -> list[tuple[Array, Array]]:
    """Return pieces of a box as start boxes."""
    middle, half = (box.lower + box.upper) / 2, (box.upper - box.lower) / 2
    pieces = []
    for a, b in zip(low, high, strict=True):
        lower, upper = box.lower.copy(), box.upper.copy()
        lower[box.lead] = max(box.lower[box.lead], middle[box.lead] + a * half[box.lead])
        upper[box.lead] = min(box.upper[box.lead], middle[box.lead] + b * half[box.lead])
        pieces.append((lower, upper))
    return pieces

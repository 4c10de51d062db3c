"""Proofs under noise: pieces of the start range are halved until they can be proved.

What noise does adds up whatever is divided, so a wide piece only makes it worse, and most attempts
at one come to nothing. They are therefore short, in rows and not in seconds, so that the same
question gets the same proof on every machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from verifier.piece import Outcome, Piece, merged
from verifier.policy import BOLD, WIDE, Policy
from verifier.problem import Box, Problem
from verifier.proof import OutOfTime, Prover, TooManyRows
from verifier.record import Record, joined

#: Error (m, rad) allowed per step.
TOLERANCE = 1e-4
#: Rows that an attempt may treat: a bold one, and one with the usual policy.
BOLD_ROWS, USUAL_ROWS = 4_000, 12_000
#: Pieces wider than this (m, m/s, rad) are attempted boldly only.
USUAL_WIDTH = 0.03
#: The whole start range is halved at most so often; then the number of rows is free.
MOST_HALVES = 6


@dataclass(frozen=True)
class _Attempt:
    policy: Policy
    most_rows: float


def prove_halved(
    problem: Problem, box: Box, piece: Piece, wanted: float, check: Callable[[], None],
    recorded: bool, report: Callable[[float], None],
) -> Outcome:  # fmt: skip
    """Prove a piece, or its halves, or theirs; report(share proved).

    check() is called often and may raise OutOfTime.
    """
    waiting, whole = [piece], piece.high - piece.low
    open_parts: list[tuple[float, float]] = []
    records: list[Record] = []
    least, leaves, cuts, network_time, shown = np.inf, 0, 0, 0.0, 0.0
    in_time = True
    while waiting and in_time:
        part = waiting.pop()
        attempts = _attempts(box, part)
        for attempt in attempts:
            record = Record(box.lead) if recorded else None
            prover = Prover(
                problem, wanted, check, record, wide=True, policy=attempt.policy,
                most_rows=attempt.most_rows,
            )  # fmt: skip
            low, high = np.array([part.low]), np.array([part.high])
            try:
                proof = prover.prove(box, low, high, TOLERANCE, part.case)
                low, high = merged(proof.low, proof.high, part)
            except TooManyRows:
                continue
            except OutOfTime:
                waiting.append(part)
                in_time = False
                break
            finally:
                cuts += prover.cuts
                network_time += prover.network_time_s
            if not low.size:
                least, leaves = min(least, proof.least), leaves + proof.leaves
                records += [record] if record is not None else []
                shown += (part.high - part.low) / whole
                report(shown)
                break
        else:
            if attempts[-1].most_rows == np.inf:
                open_parts.append((part.low, part.high))
            else:
                middle = (part.low + part.high) / 2
                halves = [Piece(part.case, *x) for x in ((middle, part.high), (part.low, middle))]
                waiting += halves
    open_parts += [(part.low, part.high) for part in waiting]
    ends = np.array(sorted(open_parts)).reshape(-1, 2)
    return Outcome(
        piece, ends[:, 0], ends[:, 1], least, leaves, cuts, shown if open_parts else 1.0, in_time,
        joined(records) if records else None, network_time,
    )  # fmt: skip


def _attempts(box: Box, part: Piece) -> list[_Attempt]:
    """Return what to try with a part of the start range; where halves are no use, without bound."""
    share = (part.high - part.low) / 2
    width = share * float(box.upper[box.lead] - box.lower[box.lead])
    last = width == 0 or share <= 0.5**MOST_HALVES
    bold = _Attempt(BOLD, BOLD_ROWS)
    usual = _Attempt(WIDE, np.inf if last else USUAL_ROWS)
    return [bold, usual] if last or width <= USUAL_WIDTH else [bold]

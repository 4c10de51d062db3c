"""Pieces of a proof that can be done side by side: parts of the start range, cases of faults."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from itertools import pairwise
from multiprocessing import get_context

import numpy as np

from verifier.halves import TOLERANCE, prove_halved
from verifier.piece import Outcome, Piece, merged
from verifier.problem import Box, Problem
from verifier.proof import OutOfTime, Prover
from verifier.record import Record

#: Errors (m, rad) allowed per step, tried in turn on what the one before left open.
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
#: What is left open of a piece is tried like that, too, if it is a smaller share of it: there small
#: differences grow so much that a polynomial does not hold them.
SMALL_REST = 1e-3
#: Pieces per worker: some are harder than others.
_PER_WORKER = 2
#: How often (s) the share that is proved is worked out.
_EVERY = 0.2


def divided(cases: int, workers: int) -> list[Piece]:
    """Return pieces that make up the whole start range in every case."""
    count = 1 if workers == 1 else max(1, -(-_PER_WORKER * workers // cases))
    # Sums of powers of 2 where count is one; neighbours share their ends in any case.
    ends = [-1 + 2 * i / count for i in range(count)] + [1.0]
    return [Piece(c, a, b) for c in range(cases) for a, b in pairwise(ends)]


def prove_piece(
    problem: Problem,
    box: Box,
    piece: Piece,
    wanted: float,
    deadline: float,
    recorded: bool,
    report: Callable[[float], None] = lambda share: None,
) -> Outcome:
    """Prove a piece, without noise, until ``deadline`` (time.monotonic).

    report(share proved) is called often.
    """
    check = _until(deadline)
    record = Record(box.lead) if recorded else None
    low, high = np.array([piece.low]), np.array([piece.high])
    least, leaves, shown = np.inf, 0, 0.0
    latest: Callable[[], float] = lambda: 0.0  # noqa: E731
    last = time.monotonic()

    def share() -> float:
        return shown + (1 - shown) * latest()

    def decided(fraction: Callable[[], float]) -> None:
        nonlocal latest, last
        latest = fraction
        if time.monotonic() > last + _EVERY:
            report(share())
            last = time.monotonic()

    ladder = [(TOLERANCE, True)]
    if not problem.wide:
        ladder = [(tolerance, False) for tolerance in TOLERANCES] + ladder
    provers: dict[bool, Prover] = {}
    in_time = True
    try:
        for tolerance, wide in ladder:
            if wide and not problem.wide and 1 - shown > SMALL_REST:
                break
            if wide not in provers:
                provers[wide] = Prover(problem, wanted, check, record, decided, wide=wide)
            latest, prover = lambda: 0.0, provers[wide]
            proof = prover.prove(box, low, high, tolerance, piece.case)
            least, leaves = min(least, proof.least), leaves + proof.leaves
            low, high = merged(proof.low, proof.high, piece)
            shown = 1 - float(np.sum(high - low)) / (piece.high - piece.low)
            if not low.size:
                break
        decided_share = shown
    except OutOfTime:
        in_time, decided_share = False, share()
    if not low.size:
        decided_share = 1.0
    used = provers.values()
    return Outcome(
        piece, low, high, least, leaves, sum(p.cuts for p in used), decided_share, in_time,
        record, sum(p.network_time_s for p in used),
    )  # fmt: skip


def _until(deadline: float) -> Callable[[], None]:
    """Return a function that raises OutOfTime after ``deadline``."""

    def check() -> None:
        if time.monotonic() > deadline:
            raise OutOfTime

    return check


def _prove(
    problem: Problem, box: Box, piece: Piece, wanted: float, deadline: float, recorded: bool,
    report: Callable[[float], None] = lambda share: None,
) -> Outcome:  # fmt: skip
    """Prove a piece in the way that suits the problem."""
    if problem.noisy:
        return prove_halved(problem, box, piece, wanted, _until(deadline), recorded, report)
    return prove_piece(problem, box, piece, wanted, deadline, recorded, report)


def prove_pieces(
    problem: Problem,
    box: Box,
    pieces: list[Piece],
    wanted: float,
    deadline: float,
    recorded: bool,
    workers: int,
    report: Callable[[float], None],
) -> Iterator[Outcome]:
    """Yield the outcomes of pieces, in the order in which they come; report(share of all)."""
    done = 0.0
    if workers == 1:
        for piece in pieces:
            outcome = _prove(
                problem, box, piece, wanted, deadline, recorded,
                lambda share: report((done + share) / len(pieces)),  # noqa: B023
            )  # fmt: skip
            done += outcome.decided
            report(done / len(pieces))
            yield outcome
        return
    # A fresh interpreter for each: onnxruntime's threads do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        waiting: set[Future[Outcome]] = {
            pool.submit(_prove, problem, box, piece, wanted, deadline, recorded) for piece in pieces
        }
        while waiting:
            ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in ended:
                outcome = future.result()
                done += outcome.decided
                report(done / len(pieces))
                yield outcome

"""Pieces of a proof that can be done side by side: parts of the start range, cases of faults."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context

import numpy as np

from verifier.models import Array
from verifier.problem import Box, Problem
from verifier.proof import OutOfTime, Prover
from verifier.record import Record

#: Errors (m, rad) allowed per step, tried in turn on what the one before left open.
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
#: The same where errors are what there is: several numbers are uncertain.
WIDE_TOLERANCES = (1e-4,)
#: What is left open of a piece is tried like that, too, if it is a smaller share of it: there small
#: differences grow so much that a polynomial does not hold them.
SMALL_REST = 1e-3
#: The ends of a row's piece are tracked to within this (in the box's units, -1 to 1).
_TRACKED = 2e-12
#: Pieces per worker: some are harder than others.
_PER_WORKER = 2
#: How often (s) the share that is proved is worked out.
_EVERY = 0.2


@dataclass(frozen=True)
class Piece:
    """The part [low, high] (within [-1, 1]) of the start range, in one case of faults."""

    case: int
    low: float
    high: float


@dataclass(frozen=True)
class Outcome:
    """What was shown of a piece.

    low, high: parts that stay open; least: proved lower bound of the margin (m) on the rest;
    decided: share of the piece that is proved; in_time: whether the piece was treated to its end;
    network_time_s: seconds spent in enclosures of the network.
    """

    piece: Piece
    low: Array
    high: Array
    least: float
    leaves: int
    cuts: int
    decided: float
    in_time: bool
    record: Record | None
    network_time_s: float = 0.0


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
    """Prove a piece until ``deadline`` (time.monotonic); report(share proved) is called often."""
    record = Record(box.lead) if recorded else None
    low, high = np.array([piece.low]), np.array([piece.high])
    least, leaves, shown = np.inf, 0, 0.0
    latest: Callable[[], float] = lambda: 0.0  # noqa: E731
    last = time.monotonic()

    def check() -> None:
        if time.monotonic() > deadline:
            raise OutOfTime

    def share() -> float:
        return shown + (1 - shown) * latest()

    def decided(fraction: Callable[[], float]) -> None:
        nonlocal latest, last
        latest = fraction
        if time.monotonic() > last + _EVERY:
            report(share())
            last = time.monotonic()

    ladder = [(tolerance, True) for tolerance in WIDE_TOLERANCES]
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
            outcome = prove_piece(
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
            pool.submit(prove_piece, problem, box, piece, wanted, deadline, recorded)
            for piece in pieces
        }
        while waiting:
            ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in ended:
                outcome = future.result()
                done += outcome.decided
                report(done / len(pieces))
                yield outcome


def merged(low: Array, high: Array, piece: Piece) -> tuple[Array, Array]:
    """Return intervals within a piece that cover the given ones, joined where they touch.

    They are a little wider, so that they cover the rows as the models mean them, too.
    """
    low, high = np.maximum(low - _TRACKED, piece.low), np.minimum(high + _TRACKED, piece.high)
    order = np.argsort(low)
    joined: list[list[float]] = []
    for a, b in zip(low[order], high[order], strict=True):
        if joined and a <= joined[-1][1]:
            joined[-1][1] = max(joined[-1][1], b)
        else:
            joined.append([a, b])
    pairs = np.array(joined).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]

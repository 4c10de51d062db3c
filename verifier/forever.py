"""Safe for ever: an inductive start set per corner.

The argument that the paper's last section asks for. From the start set every run is shown to
reach the next hall's frame inside a box of states; from that box the next one, and so on, until
a box lies inside an earlier one. All halls are alike, so the runs then stay within these boxes
at every corner, however long they drive, and are safe on the way between.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from verifier.disturbed import cases
from verifier.models import Array, bounds
from verifier.piece import Piece, merged
from verifier.pieces import TOLERANCES
from verifier.problem import Box, Problem
from verifier.proof import OutOfTime, Prover
from verifier.rows import F, Rows, join

#: Corners after which no box is expected to close the circle any more.
MOST_CORNERS = 60
#: A run that needs more control periods than this from corner to corner is given up.
MOST_STEPS = 400
#: Boxes are made larger by this share of their width, and by this much (m, m/s, rad), so that the
#: next ones, of a motion that settles, come to lie within.
GROWTH, LEAST = 0.02, 1e-6


@dataclass(frozen=True)
class Corner:
    """States ``[4]`` (lower and upper bounds) right after the change to the next hall's frame."""

    lower: Array
    upper: Array

    def contains(self, other: Corner) -> bool:
        """Tell whether all of another's states are in this one."""
        return bool((self.lower <= other.lower).all() and (other.upper <= self.upper).all())

    def grown(self) -> Corner:
        """Return a slightly larger box."""
        more = GROWTH * (self.upper - self.lower) + LEAST
        return Corner(self.lower - more, self.upper + more)


@dataclass(frozen=True)
class Forever:
    """What was shown: whether all runs are safe for ever, with what margin (m).

    corners: the boxes; returns: index of the box that the last one's runs come back to; leaves
    and cuts as in Proof; note: why not, if so.
    """

    proved: bool
    least: float
    corners: tuple[Corner, ...]
    returns: int
    leaves: int
    cuts: int
    note: str


def prove_forever(
    problem: Problem, box: Box, wanted: float, deadline: float,
    report: Callable[[float], None] = lambda share: None,
) -> Forever:  # fmt: skip
    """Look for an inductive set; report(share of the corners that may be needed).

    A corner's box holds the runs of all cases of missing rays. Raises disturbed.TooManyChoices.
    """
    leaves, cuts, least = 0, 0, np.inf
    corners: list[Corner] = []

    def ended(proved: bool, returns: int, note: str) -> Forever:
        return Forever(proved, least, tuple(corners), returns, leaves, cuts, note)

    if not _alike(problem):
        return ended(False, -1, "the halls are not alike, or the track is not closed")

    def check() -> None:
        if time.monotonic() > deadline:
            raise OutOfTime

    one = replace(problem, steps=MOST_STEPS)
    frame = 0
    try:
        while len(corners) < MOST_CORNERS:
            leg = _drive(one, box, frame, wanted, check)
            leaves, cuts = leaves + leg.leaves, cuts + leg.cuts
            if leg.rows is None:
                return ended(False, -1, f"not proved safe after corner {len(corners)}")
            least = min(least, leg.least)
            frame = int(leg.rows.frame[0])
            low, high = bounds(leg.rows.state)
            reached = Corner(low.min(axis=1), high.max(axis=1))
            for i, earlier in enumerate(corners):
                if earlier.contains(reached):
                    return ended(True, i, "")
            corners.append(reached.grown())
            report(len(corners) / MOST_CORNERS)
            box = Box(corners[-1].lower, corners[-1].upper, F)
            one = replace(one, lower=box.lower, upper=box.upper)
    except OutOfTime:
        return ended(False, -1, "the time limit was reached")
    return ended(False, -1, f"no circle of boxes closes within {MOST_CORNERS} corners")


@dataclass(frozen=True)
class _Leg:
    """The drive to the next corner: the rows that arrive (None: not all do), and what it took."""

    rows: Rows | None
    least: float
    leaves: int
    cuts: int


def _drive(
    problem: Problem, box: Box, frame: int, wanted: float, check: Callable[[], None]
) -> _Leg:
    """Show that all runs from a box come to the next hall's frame, whichever rays are missing."""
    prover = Prover(problem, wanted, check, to_corner=True)
    arrived: list[Rows] = []
    least, leaves = np.inf, 0
    for case in range(len(cases(problem.disturbance, problem.plant.lidar.rays))):
        whole = Piece(case, -1.0, 1.0)
        low, high = np.array([whole.low]), np.array([whole.high])
        for tolerance in TOLERANCES:
            proof = prover.prove(box, low, high, tolerance, case, frame)
            least, leaves = min(least, proof.least), leaves + proof.leaves
            arrived += prover.arrived
            low, high = merged(proof.low, proof.high, whole)
            if not low.size:
                break
        if low.size:
            return _Leg(None, least, leaves, prover.cuts)
    return _Leg(join(arrived), least, leaves, prover.cuts)


def _alike(problem: Problem) -> bool:
    """Tell whether all halls are the same to the car."""
    track = problem.plant.track
    return bool((track.alike == 0).all() and (problem.safety.alike == 0).all()) and all(
        frame.advance is not None for frame in track.frames
    )

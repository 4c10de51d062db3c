"""Pieces of a proof, and what was shown of one: plain data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from verifier.models import Array
from verifier.record import Record

#: The ends of a row's piece are tracked to within this (in the box's units, -1 to 1): a
#: certificate allows each of many divisions to be wider by 2^-40.
_TRACKED = 1e-10


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

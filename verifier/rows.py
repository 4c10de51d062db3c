"""Rows: pieces of the start set and models of the state on each.

The state is (s, f, v, theta) as Taylor models over one piece. To split a piece, or to keep
only the part of it where a wall decision can go one way, is to substitute
x = middle + half * x' into all of its models, or the like for an error symbol.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from verifier.arithmetic import BASE, KNOWN, PAIRS
from verifier.models import TERMS, Array, Models, norm, substitute
from verifier.rounding import TINY, UP, gamma

S, F, V, THETA = range(4)


@dataclass(frozen=True)
class Decision:
    """An assumption about one ray in the current step.

    positive: the sign of the cross product X of faces ``front`` and ``back`` of an obstacle,
    seen along the ray (verifier.walls). Its other sign is another row's business.
    """

    polygon: int
    front: int
    back: int
    ray: int
    positive: bool


@dataclass(frozen=True)
class Inside:
    """An assumption about the region in which rays are missing: whether the car is in it."""

    positive: bool


@dataclass(frozen=True)
class Beyond:
    """An assumption about the line past which the next hall's frame is used."""

    positive: bool


Assumption = Decision | Inside | Beyond


@dataclass(frozen=True, eq=False)
class Rows:
    """A batch of rows.

    state: models ``[4, rows]`` of s, f, v, theta; frame: ``[rows]``; low, high: ``[rows]``,
    the piece in the units of the start range, -1 to 1: all starts that the row may stem from,
    up to the rounding of these two numbers; least: ``[rows]``, proved lower
    bound of the margin so far (m); decisions: per row, assumptions for the current step;
    kink: ``[rows]``, kinks of up to this (1/m) go into the radius in the current step;
    tried: ``[rows]``, the error of the current step on a wider piece (inf at first); borne:
    ``[rows]``, the error of the last step if splitting did not help against it, else 0;
    case: ``[rows]``, which rays are missing (verifier.problem); splits: ``[rows]``, how often
    the row was divided other than along the start position; gathered: ``[rows]``, whether x is
    not the start position any more (verifier.gather); node: ``[rows]``, the row's number in the
    record (verifier.record).
    """

    state: Models
    frame: NDArray[np.intp]
    low: Array
    high: Array
    least: Array
    decisions: tuple[tuple[Assumption, ...], ...]
    kink: Array
    tried: Array
    borne: Array
    case: NDArray[np.intp]
    splits: NDArray[np.intp]
    gathered: NDArray[np.bool_]
    node: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, index: NDArray) -> Rows:
        """Return the rows at ``index`` (integers or booleans)."""
        index = np.flatnonzero(index) if index.dtype == bool else index
        return Rows(
            Models(self.state.c.take(index, axis=-1), self.state.radius.take(index, axis=-1)),
            self.frame[index],
            self.low[index],
            self.high[index],
            self.least[index],
            tuple(self.decisions[i] for i in index),
            self.kink[index],
            self.tried[index],
            self.borne[index],
            self.case[index],
            self.splits[index],
            self.gathered[index],
            self.node[index],
        )

    def restrict(self, low: Array, high: Array) -> Rows:
        """Return the rows on the parts [low, high] (within [-1, 1]) of their pieces.

        The new models cover a little more than that, and the new pieces say so: where a piece is
        cut next is told in parts of what its models cover. What a gathered row stems from is not
        known of its parts.
        """
        middle, half = middle_half(low, high)
        width = (self.high - self.low) / 2
        centre = (self.high + self.low) / 2
        return replace(
            self,
            state=substitute(self.state, middle, half),
            low=np.where(self.gathered, self.low, centre + width * (middle - half)),
            high=np.where(self.gathered, self.high, centre + width * (middle + half)),
            splits=self.splits + self.gathered,
        )

    def narrow(self, symbol: NDArray[np.intp], low: Array, high: Array) -> Rows:
        """Return the rows with one error symbol each (``[rows]``) kept within [low, high]."""
        middle, half = middle_half(low, high)
        c = self.state.c.copy()
        for j in np.unique(symbol):
            some = np.flatnonzero(symbol == j)
            c[..., some] = _narrowed(c[..., some], int(j), middle[some], half[some])
        # No coefficient is a sum of more than 8 products, of factors that add up to 4 at most.
        radius = (self.state.radius + 4 * gamma(10) * norm(self.state.c)) * UP + TINY
        return replace(self, state=Models(c, radius), splits=self.splits + 1)


def _narrowed(c: Array, symbol: int, middle: Array, half: Array) -> Array:
    """Return coefficients in e' where e = middle + half e' for one symbol; never for a product."""
    c, count = c.copy(), (len(c) - TERMS) // 2
    for k in (0, 1):  # what is constant, and what goes with x
        place = [TERMS + 2 * j + k for j in range(count)]
        c[k] += c[place[symbol]] * middle
        if count >= KNOWN:
            for pair, (i, j) in enumerate(PAIRS, BASE):
                product = c[place[pair]]
                if i == j == symbol:  # 2 e^2 - 1
                    c[k] += product * (2 * middle**2 + half**2 - 1)
                    c[place[i]] += product * (4 * middle)
                    c[place[pair]] = product * half**2
                elif symbol in {i, j}:
                    c[place[i + j - symbol]] += product * middle
                    c[place[pair]] = product * half
        c[place[symbol]] *= half
    return c


def middle_half(low: Array, high: Array) -> tuple[Array, Array]:
    """Return middle and half width of intervals within [-1, 1], the latter rounded up."""
    return (low + high) / 2, (high - low) / 2 * UP + 2.0**-50


def fresh(
    state: Models, frame: NDArray[np.intp], low: Array, high: Array, least: Array,
    case: NDArray[np.intp], gathered: bool,
) -> Rows:  # fmt: skip
    """Return rows of which nothing has been tried, assumed or recorded yet."""
    count = len(frame)
    return Rows(
        state=state,
        frame=frame,
        low=low,
        high=high,
        least=least,
        decisions=((),) * count,
        kink=np.zeros(count),
        tried=np.full(count, np.inf),
        borne=np.zeros(count),
        case=case,
        splits=np.zeros(count, dtype=np.intp),
        gathered=np.full(count, gathered),
        node=np.full(count, -1),
    )


#: All fields of rows that are ``[rows]``.
_ARRAYS = (
    "frame", "low", "high", "least", "kink", "tried", "borne", "case", "splits", "gathered", "node",
)  # fmt: skip


def join(parts: list[Rows]) -> Rows:
    """Join batches of rows."""
    if len(parts) == 1:
        return parts[0]
    arrays = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _ARRAYS}
    return Rows(
        state=Models(
            np.concatenate([p.state.c for p in parts], axis=-1),
            np.concatenate([p.state.radius for p in parts], axis=-1),
        ),
        decisions=tuple(d for p in parts for d in p.decisions),
        **arrays,
    )

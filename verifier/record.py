"""The record of a proof as it is made: every row, and how it follows from an earlier one.

It becomes a certificate (verifier.certificate), which a checker that trusts none of this can
validate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from verifier.certificate import (
    ADVANCE,
    ADVANCE_GUARD,
    CROSS,
    GATHERED,
    IMAGE,
    PART,
    ROOT,
    TURN,
    Certificate,
)
from verifier.models import TERMS, Array
from verifier.rows import Assumption, Beyond, Decision, Rows

Index = NDArray[np.intp]


@dataclass(frozen=True)
class Part:
    """Which part of its parent a row covers: one parameter's interval ``[rows]`` in [-1, 1].

    parameter: ``[rows]``, 0 for x, 1 + j for the error symbol j.
    """

    parameter: Index
    low: Array
    high: Array


def everything(count: int) -> Part:
    """Return all of so many rows, as parts."""
    return Part(np.zeros(count, dtype=np.intp), np.full(count, -1.0), np.ones(count))


class Record:
    """Collects rows; methods return the numbers ``[rows]`` of the rows that they add.

    lead: the start component that x runs along.
    """

    def __init__(self, lead: int) -> None:
        self.lead = lead
        self._chunks: list[dict[str, NDArray]] = []
        self._count = 0
        self._guards: dict[Assumption, int] = {}
        self._elsewhere: list[Index] = []
        self._into: list[tuple[Index, np.intp]] = []

    def roots(self, rows: Rows, low: Array, high: Array) -> Index:
        """Add rows that begin on the pieces [low, high] of the start range."""
        none = np.full(len(rows), -1)
        piece = Part(np.zeros(len(rows), dtype=np.intp), low, high)
        return self._add(rows, ROOT, 0, none, piece, none)

    def parts(
        self, rows: Rows, step: int, part: Part, assumed: Sequence[Assumption | None] | None = None
    ) -> Index:
        """Add rows that cover parts of the rows ``rows.node``, with what each assumes."""
        guards = [-1 if a is None else self._guard(a) for a in assumed or [None] * len(rows)]
        return self._add(rows, PART, step, rows.node, part, np.array(guards, dtype=int))

    def moved(self, rows: Rows, step: int, part: Part) -> Index:
        """Add rows in the next hall's frame that cover parts of the rows ``rows.node``."""
        guard = np.full(len(rows), self._guard(Beyond(True)))
        return self._add(rows, ADVANCE, step, rows.node, part, guard)

    def images(self, rows: Rows, step: int) -> Index:
        """Add rows that contain what a step makes of the rows ``rows.node``."""
        none = np.full(len(rows), -1)
        return self._add(rows, IMAGE, step, rows.node, everything(len(rows)), none)

    def gathered(self, rows: Rows, step: int, whole: Rows) -> Index:
        """Add a row that contains rows."""
        none = np.full(1, -1)
        nodes = self._add(whole, GATHERED, step, none, everything(1), none)
        self._into.append((rows.node, nodes[0]))
        return nodes

    def give_up(self, rows: Rows) -> None:
        """Note that rows are left to later roots."""
        self._elsewhere.append(rows.node)

    def _guard(self, assumption: Assumption) -> int:
        return self._guards.setdefault(assumption, len(self._guards))

    def _add(
        self, rows: Rows, kind: int, step: int, parent: Index, part: Part, guard: Index
    ) -> Index:
        count, symbols = len(rows), rows.state.symbols
        piece = np.tile([-1.0, 1.0], (count, 1 + symbols, 1))
        piece[np.arange(count), part.parameter] = np.stack([part.low, part.high], axis=1)
        c = rows.state.c
        spread = c[TERMS:].reshape(symbols, 2, 4, count).transpose(3, 2, 0, 1)
        self._chunks.append(
            {
                "step": np.full(count, step),
                "frame": rows.frame,
                "case": rows.case,
                "parent": parent,
                "kind": np.full(count, kind),
                "centre": np.moveaxis(c[:TERMS], (0, 1, 2), (2, 1, 0)),
                "spread": spread,
                "radius": rows.state.radius.T,
                "piece": piece,
                "guard": guard,
            }
        )
        first, self._count = self._count, self._count + count
        return np.arange(first, self._count)

    def append(self, other: Record) -> None:
        """Add all rows of another record."""
        guards = np.array([self._guard(g) for g in other._guards] + [-1])
        for chunk in other._chunks:
            parent = np.where(chunk["parent"] < 0, -1, chunk["parent"] + self._count)
            self._chunks.append({**chunk, "parent": parent, "guard": guards[chunk["guard"]]})
        self._elsewhere += [nodes + self._count for nodes in other._elsewhere]
        self._into += [(n + self._count, whole + self._count) for n, whole in other._into]
        self._count += other._count

    def certificate(
        self, instance_sha256: str, weights_sha256: str, margin: float,
        missing: NDArray[np.bool_],
    ) -> Certificate:  # fmt: skip
        """Return what was recorded as a certificate; margin (m): claimed; missing: the cases."""
        symbols = max(chunk["spread"].shape[2] for chunk in self._chunks)
        chunks = [_padded(chunk, symbols) for chunk in self._chunks]
        arrays: dict[str, Any] = {
            name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]
        }
        elsewhere = np.zeros(self._count, dtype=bool)
        for nodes in self._elsewhere:
            elsewhere[nodes] = True
        into = np.full(self._count, -1)
        for nodes, whole in self._into:
            into[nodes] = whole
        arrays |= {"elsewhere": elsewhere, "into": into}
        arrays = _pruned(arrays)
        guards = [_guard_columns(g) for g in self._guards]
        columns = np.array(guards, dtype=int).reshape(-1, 6).T
        return Certificate(
            instance_sha256=instance_sha256,
            weights_sha256=weights_sha256,
            margin=margin,
            lead=self.lead,
            guard_kind=columns[0],
            ray=columns[1],
            obstacle=columns[2],
            front=columns[3],
            back=columns[4],
            positive=columns[5].astype(bool),
            missing=missing,
            **arrays,
        )


def _padded(chunk: dict[str, Any], symbols: int) -> dict[str, Any]:
    """Return rows with so many symbols: the new ones, which come first, do nothing."""
    more = symbols - chunk["spread"].shape[2]
    piece, count = chunk["piece"], len(chunk["piece"])
    whole = np.tile([-1.0, 1.0], (count, more, 1))
    return {
        **chunk,
        "spread": np.concatenate([np.zeros((count, 4, more, 2)), chunk["spread"]], axis=2),
        "piece": np.concatenate([piece[:, :1], whole, piece[:, 1:]], axis=1),
    }


def _pruned(arrays: dict[str, Any]) -> dict[str, Any]:
    """Return the rows without those all of whose ends are given up: the first of them is instead.

    Their margins are no part of what is claimed.
    """
    parent, into = arrays["parent"], arrays["into"]
    count = len(parent)
    alive = np.zeros(count, dtype=bool)  # whether some end is proved
    has_child = np.zeros(count, dtype=bool)
    has_child[parent[parent >= 0]] = True
    for i in range(count - 1, -1, -1):  # parents have smaller numbers
        if into[i] >= 0:
            alive[i] = alive[into[i]]
        elif not has_child[i]:
            alive[i] = not arrays["elsewhere"][i]
        if alive[i] and parent[i] >= 0:
            alive[parent[i]] = True
    gone = ~alive & (parent >= 0) & ~alive[parent]
    if (gone & (into >= 0)).any():  # gathered rows are never given up
        return arrays
    number = np.cumsum(~gone) - 1
    kept = {name: values[~gone] for name, values in arrays.items()}
    kept["elsewhere"] = ~alive[~gone]
    for name in ("parent", "into"):
        kept[name] = np.where(kept[name] < 0, -1, number[kept[name]])
    return kept


def _guard_columns(guard: Assumption) -> tuple[int, ...]:
    """Return kind, ray, obstacle, front, back, positive."""
    if isinstance(guard, Decision):
        return (CROSS, guard.ray, guard.polygon, guard.front, guard.back, int(guard.positive))
    kind = ADVANCE_GUARD if isinstance(guard, Beyond) else TURN
    return (kind, -1, -1, -1, -1, int(guard.positive))


def joined(records: Sequence[Record]) -> Record:
    """Return one record of all rows."""
    if len(records) == 1:
        return records[0]
    record = Record(records[0].lead)
    for other in records:
        record.append(other)
    return record

"""The order in which rows are treated: together where they are few, in turn where many."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from verifier.models import Array
from verifier.rows import Rows, join


class Queue:
    """Rows waiting at each control step.

    The deepest step with a full batch comes first, so that many rows do not pile up; else the
    first step, so that a few stay together. At every ``every``th step (0: none) the rows wait for
    each other. ended: the rows that are done with all steps.
    """

    def __init__(self, rows: Rows, steps: int, batch: int, every: int = 0) -> None:
        self._waiting: dict[int, list[Rows]] = {}
        self._steps, self._batch = steps, batch
        self._whole = length(rows.low, rows.high)
        self.ended: list[Rows] = []
        self._taken: Rows | None = None
        self._every = every
        self._released = {0}
        self.put(0, rows)

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, step: int, rows: Rows) -> None:
        """Add rows before a step."""
        if not len(rows):
            return
        if step < self._steps:
            self._waiting.setdefault(step, []).append(rows)
        else:
            self.ended.append(rows)

    def done(self, step: int, rows: Rows) -> None:
        """Add what became of the rows last taken, after their step."""
        self._taken = None
        self.put(step + 1, rows)

    def together(self) -> tuple[int, Rows] | None:
        """Return all rows of a step at which they wait for each other, once they are all there."""
        step = min(self._waiting)
        if not self._every or step % self._every or step in self._released:
            return None
        self._released.add(step)
        return step, join(self._waiting.pop(step))

    def take(self) -> tuple[int, Rows]:
        """Return a step, and rows to do it."""
        counts = {step: sum(map(len, parts)) for step, parts in self._waiting.items()}
        full = [
            step for step, count in counts.items()
            if count >= self._batch and not self._held(step)
        ]  # fmt: skip
        step = max(full) if full else min(counts)
        rows = join(self._waiting.pop(step))
        if len(rows) > self._batch:
            self.put(step, rows.take(np.arange(self._batch, len(rows))))
            rows = rows.take(np.arange(self._batch))
        self._taken = rows
        return step, rows

    def _held(self, step: int) -> bool:
        return bool(self._every) and step % self._every == 0 and step not in self._released

    def finished(self, failed: Sequence[Rows]) -> float:
        """Return the share of the start pieces of which nothing is waiting or failed."""
        rest = [r for parts in self._waiting.values() for r in parts] + list(failed)
        rest += [self._taken] if self._taken is not None else []
        low = np.concatenate([np.zeros(0), *(r.low for r in rest)])
        high = np.concatenate([np.zeros(0), *(r.high for r in rest)])
        return max(0.0, 1 - length(low, high) / self._whole)


def length(low: Array, high: Array) -> float:
    """Return the length of the union of intervals."""
    order = np.argsort(low)
    low, high = low[order], np.maximum.accumulate(high[order])
    before = np.concatenate([[-np.inf], high[:-1]])
    return float(np.sum(np.maximum(high - np.maximum(low, before), 0.0)))

"""The order of rows, and the share of the start that is done with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from enclosed import rows_of
from hypothesis import given, settings
from hypothesis import strategies as st

from verifier.models import TERMS, Models
from verifier.queue import Queue, length
from verifier.rows import Rows

SEEDS = st.integers(0, 2**32 - 1)


def pieces(*ends: tuple[float, float]) -> Rows:
    low, high = np.array(ends, dtype=float).reshape(-1, 2).T
    state = Models(np.zeros((TERMS, 4, len(low))), np.zeros((4, len(low))))
    return replace(rows_of(state), low=low, high=high)


def test_few_rows_stay_together_and_many_go_on():
    queue = Queue(pieces((-1, 0), (0, 1)), 5, batch=3)
    step, rows = queue.take()
    assert (step, len(rows)) == (0, 2)
    queue.done(0, pieces((-1, 0), (0, 1)))
    queue.put(3, pieces((0.2, 0.3)))
    assert queue.take()[0] == 1  # no full batch: the first step
    queue.done(1, pieces())
    queue.put(3, pieces((0, 0.1), (0.1, 0.2), (0.3, 0.4)))
    queue.put(1, pieces((0.5, 0.6)))
    step, rows = queue.take()
    assert (step, len(rows)) == (3, 3)  # the deepest full batch, and no more than a batch
    queue.done(3, rows)
    assert queue.take()[0] == 4
    queue.done(4, rows)
    assert sum(map(len, queue.ended)) == 3
    assert [queue.take()[0] for _ in range(2)] == [1, 3]
    assert not queue


def test_rows_wait_for_each_other():
    queue = Queue(pieces((-1, 0), (0, 1)), 9, batch=1, every=2)
    assert queue.together() is None  # not at the start
    taken = []
    while queue:
        met = queue.together()
        if met is not None:
            # All are there, and none is behind.
            assert (met[0], len(met[1])) == (met[0], 2)
            taken.append(("together", met[0]))
            queue.put(*met)
        step, rows = queue.take()
        taken.append(("take", step))
        queue.done(step, rows)
    assert [what for what in taken if what[0] == "together"] == [
        ("together", step) for step in (2, 4, 6, 8)
    ]
    for step in (2, 4, 6, 8):
        released = taken.index(("together", step))
        assert all(at < step for what, at in taken[:released] if what == "take")
    assert sum(map(len, queue.ended)) == 2


@settings(max_examples=60)
@given(SEEDS)
def test_no_row_is_lost_and_the_share_is_honest(seed):
    """A play of dividing, failing and ending; the share is worked out anew on a fine grid."""
    random = np.random.default_rng(seed)
    edges = np.sort(random.uniform(-1, 1, 3))
    start = pieces((edges[0], edges[1]), (edges[1], edges[2]))
    steps, every = int(random.integers(1, 6)), int(random.choice([0, 2]))
    queue = Queue(start, steps, batch=int(random.integers(1, 5)), every=every)
    failed: list[Rows] = []
    grid = edges[0] + (edges[2] - edges[0]) * (np.arange(4000) + 0.5) / 4000
    whole, shares = 2, []
    while queue:
        met = queue.together()
        if met is not None:
            queue.put(*met)
        step, rows = queue.take()
        after = []
        for low, high in zip(rows.low, rows.high, strict=True):
            kind = random.random()
            if kind < 0.2:
                failed.append(pieces((low, high)))
                whole -= 1
            elif kind < 0.5:
                cut = random.uniform(low, high)
                after += [(low, cut), (cut, high)]
                whole += 1
            else:
                after.append((low, high))
        # In the middle of a step what was taken counts as waiting.
        share = queue.finished(failed)
        busy = np.zeros(len(grid), dtype=bool)
        waiting = [r for parts in queue._waiting.values() for r in parts]
        for part in [*waiting, *failed, rows]:
            for low, high in zip(part.low, part.high, strict=True):
                busy |= (grid >= low) & (grid <= high)
        assert share == pytest.approx(1 - busy.mean(), abs=5e-3)
        shares.append(share)
        queue.done(step, pieces(*after) if after else pieces())
    assert sum(map(len, queue.ended)) == whole
    assert (np.diff(shares) >= -1e-12).all()
    lost = sum(float(np.sum(part.high - part.low)) for part in failed)
    assert queue.finished(failed) == pytest.approx(1 - lost / (edges[2] - edges[0]))


def test_rows_upon_each_other_count_once():
    """Several rows of one piece: it is done with only when all of them are."""
    queue = Queue(pieces((-1, 1), (-1, 1)), 2, batch=1)
    queue.take()
    assert queue.finished([]) == 0
    queue.done(0, pieces())
    assert queue.finished([]) == 0
    queue.take()
    queue.done(0, pieces())
    assert queue.finished([]) == 1
    assert queue.finished([pieces((0, 0.5)), pieces((0.25, 0.5))]) == 0.75


def test_the_length_of_a_union():
    def of(*ends: tuple[float, float]) -> float:
        rows = pieces(*ends)
        return length(rows.low, rows.high)

    assert of() == 0
    assert of((0, 1), (2, 3)) == 2
    assert of((0, 1), (0.5, 3), (0.6, 0.7)) == 3
    assert of((2, 3), (0, 1), (0, 1)) == 2

"""Gathering rows: every member of every given row is in the one that contains them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from enclosed import rows_of
from exact_members import Place, arb, flint, member, places, random_models
from hypothesis import given, settings
from hypothesis import strategies as st

from verifier import gather as under_test
from verifier.gather import DIRECTIONS, gather, gathered
from verifier.models import TERMS, Models
from verifier.rows import THETA, F, Rows, S, V, join

SEEDS = st.integers(0, 2**32 - 1)
SYMBOLS = 6


def cloud(random: np.random.Generator, count: int, size: float, scatter: float) -> Rows:
    """Return rows near each other whose states stray in all directions."""
    state = random_models(random, (4, count), size, SYMBOLS, size, 0.0)
    state.c[0] = np.array([0.7, 9.0, 2.2, -0.3])[:, None] + scatter * random.normal(size=(4, count))
    state.c[1:] *= 10 ** random.uniform(-2, 0, (1, 4, 1))
    state.radius[V] *= random.integers(0, 2)
    rows = rows_of(state)
    return replace(
        rows, least=random.random(count), low=-random.random(count), high=random.random(count)
    )


def reach(whole: Rows, values: list[arb]) -> float:
    """Return how far a state is out in the frame of a gathered row: more than 1 is outside.

    Its models are linear: the symbols are solved for exactly, at the end of the radii that
    helps least; what is solved for then lies in [-1, 1] if the radii are of no help.
    """
    c, radius = whole.state.c[:, :, 0], whole.state.radius[:, 0]
    used = [1, *(TERMS + 2 * j for j in range(DIRECTIONS))]
    rest = np.setdiff1d(np.arange(1, len(c)), used)
    assert not c[rest].any()
    matrix = flint.arb_mat([[float(c[k, i]) for k in used] for i in range(4)])
    off = flint.arb_mat([[value - arb(float(c[0, i]))] for i, value in enumerate(values)])
    # |M^-1 off| less what the radii, anywhere in their box, take off.
    inverse = matrix.inv()
    y = inverse * off
    return max(
        float(
            abs(y[k, 0])
            - sum((abs(inverse[k, i]) * arb(float(radius[i])) for i in range(4)), arb(0))
        )
        for k in range(4)
    )


def worst(rows: Rows, whole: Rows, random: np.random.Generator) -> float:
    found = []
    for row in range(len(rows)):
        for place in places(random, SYMBOLS):
            rest = random.choice([-1.0, 1.0], 4)
            values = [member(rows.state, (i, row), place, float(rest[i])) for i in range(4)]
            found.append(reach(whole, values))
    return max(found)


@settings(max_examples=25)
@given(SEEDS, st.sampled_from([1e-9, 1e-4, 0.05]), st.sampled_from([0.0, 1e-3, 0.1]))
def test_every_member_of_every_row_is_in_the_gathered_row(seed, size, scatter):
    random = np.random.default_rng(seed)
    rows = cloud(random, int(random.integers(1, 6)), size, scatter)
    whole = gathered(rows, SYMBOLS).rows
    assert len(whole) == 1
    assert whole.state.symbols == SYMBOLS
    assert worst(rows, whole, random) <= 1
    assert whole.least[0] == rows.least.min()
    assert whole.low[0] == rows.low.min()
    assert whole.high[0] == rows.high.max()
    assert whole.gathered[0]


def extreme(rows: Rows, axis: np.ndarray) -> list[list[arb]]:
    """Return the members of each row that go farthest along a direction, each way."""
    found = []
    for row in range(len(rows)):
        c = rows.state.c[:, :, row] @ axis
        for way in (-1.0, 1.0):
            e = way * np.where(c[TERMS::2] + way * c[TERMS + 1 :: 2] >= 0, 1.0, -1.0)
            place, rest = Place(way, e), way * np.where(axis >= 0, 1.0, -1.0)
            found.append([member(rows.state, (i, row), place, float(rest[i])) for i in range(4)])
    return found


def farthest(seed: int) -> float:
    """Return how far members go at most that are sought along the new row's own directions."""
    random = np.random.default_rng(seed)
    rows = cloud(random, 4, 1e-2, 1e-2)
    rows.state.c[2:TERMS] = 0.0
    whole = gathered(rows, SYMBOLS).rows
    used = [1, *(TERMS + 2 * j for j in range(DIRECTIONS))]
    directions = np.linalg.inv(whole.state.c[used, :, 0].T)
    return max(reach(whole, m) for axis in directions for m in extreme(rows, axis))


def test_members_reach_the_sides_of_the_gathered_row():
    """It is no larger than it need be; and a tenth less, along any direction, would show."""
    for seed in range(5):
        assert 0.95 < farthest(seed) <= 1


def test_the_check_sees_a_gathered_row_that_is_too_small(monkeypatch):
    original = under_test.bounds

    def bounds(models: Models):
        low, high = original(models)
        return 0.9 * low, 0.9 * high

    monkeypatch.setattr(under_test, "bounds", bounds)
    assert farthest(0) > 1


def test_any_directions_will_do(monkeypatch):
    """They are found by an eigenvalue routine, which is not trusted to be exact."""
    random = np.random.default_rng(2)
    bent = np.eye(4) + 0.1 * random.normal(size=(4, 4))
    monkeypatch.setattr(under_test, "_directions", lambda state: bent)
    for _ in range(5):
        rows = cloud(random, 3, 1e-3, 1e-3)
        assert worst(rows, gathered(rows, SYMBOLS).rows, random) <= 1


def test_directions_are_orthogonal_and_along_the_cloud():
    random = np.random.default_rng(4)
    along = np.array([0.6, 0.0, 0.8])
    state = random_models(random, (4, 50), 1e-9, SYMBOLS, 0.0, 0.0)
    state.c[0][[S, F, THETA]] = along[:, None] * random.normal(size=50)
    axes = under_test._directions(state)
    assert np.allclose(axes.T @ axes, np.eye(4), atol=1e-14)
    assert abs(axes[[S, F, THETA], 0] @ along) == pytest.approx(1, abs=1e-9)
    assert axes[:, 3].tolist() == [0, 0, 1, 0]
    assert np.isfinite(
        under_test._directions(rows_of(Models(state.c[..., :1], state.radius[:, :1])).state)
    ).all()


def box_rows(centres: list[float], half: float) -> Rows:
    """Return boxes side by side along s."""
    c = np.zeros((TERMS + 2 * SYMBOLS, 4, len(centres)))
    c[0, S] = centres
    c[1, S], c[TERMS, F], c[TERMS + 2, THETA] = half, half / 2, half / 4
    return rows_of(Models(c, np.zeros((4, len(centres)))))


def put_together(rows: Rows) -> tuple[list[Rows], list[tuple[Rows, Rows]]]:
    noted: list[tuple[Rows, Rows]] = []

    def note(some: Rows, whole: Rows) -> Rows:
        noted.append((some, whole))
        return whole

    return gather(rows, SYMBOLS, note), noted


def test_neighbours_become_one_row_and_distant_rows_stay_apart():
    apart = box_rows([0.1, 0.12, 0.14, 2.1, 2.12, 2.14], 0.01)
    done, noted = put_together(apart)
    assert [len(r) for r in done] == [1, 1]
    assert sorted(some.state.c[0, S].tolist() for some, _ in noted) == [
        [0.1, 0.12, 0.14], [2.1, 2.12, 2.14],
    ]  # fmt: skip
    done, noted = put_together(box_rows([0.1, 5.0], 0.01))
    assert sorted(join(done).state.c[0, S].tolist()) == [0.1, 5.0]
    assert not noted
    assert not join(done).gathered.any()


@settings(max_examples=15)
@given(SEEDS)
def test_whatever_is_gathered_no_row_is_lost(seed):
    """Each row given is in the result, or noted as part of a row in the result."""
    random = np.random.default_rng(seed)
    rows = cloud(random, 12, 10 ** random.uniform(-4, -1), 10 ** random.uniform(-3, 0))
    rows = replace(rows, node=np.arange(12))
    done, noted = put_together(rows)
    after = join(done)
    kept = after.node[~after.gathered].tolist()
    inside = [n for some, _ in noted for n in some.node.tolist()]
    assert sorted(kept + inside) == list(range(12))
    assert after.gathered.sum() == len(noted)
    for some, whole in noted:
        assert worst(some, whole, random) <= 1

"""Rows: restriction, the error frame, start boxes, and cuts lose no member."""

from __future__ import annotations

import numpy as np
import pytest
from exact_members import Place, arb, excess, member, places, random_models
from hypothesis import example, given, settings
from hypothesis import strategies as st

from verifier import rows as under_test
from verifier.cuts import parts
from verifier.models import TERMS, Models, error_spread
from verifier.problem import Box, start_rows
from verifier.proof import GAP, uncovered
from verifier.rows import THETA, F, Rows, S, V, consolidate, join, substitute

SEEDS = st.integers(0, 2**32 - 1)
WIDTHS = st.sampled_from([1e-9, 1e-4, 0.1, 1.0])
ERRORS = st.sampled_from([0.0, 1e-12, 1e-6, 1e-2])
ROWS = 3


def make_rows(state: Models) -> Rows:
    count = state.radius.shape[-1]
    return Rows(
        state=state,
        frame=np.zeros(count, dtype=np.intp),
        low=np.full(count, -1.0),
        high=np.ones(count),
        least=np.full(count, np.inf),
        decisions=((),) * count,
        kink=np.zeros(count),
        tried=np.full(count, np.inf),
    )


def inner(random: np.random.Generator, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return parts of [-1, 1]: any, halves, slivers at the ends."""
    low = random.uniform(-1, 1, rows)
    high = low + (1 - low) * random.random(rows) ** random.integers(1, 40)
    kind = random.integers(0, 4, rows)
    low = np.where(kind == 0, -1.0, np.where(kind == 1, 0.0, low))
    high = np.where(kind == 0, 0.0, np.where(kind == 1, 1.0, high))
    return low, np.maximum(low, high)


@settings(max_examples=60)
@given(SEEDS, WIDTHS, ERRORS)
def test_substitution_keeps_every_member(seed, width, error):
    random = np.random.default_rng(seed)
    models = random_models(random, (2, ROWS), width, 2, error)
    low, high = inner(random, ROWS)
    middle, half = (low + high) / 2, (high - low) / 2
    result = substitute(models, middle, half)
    for row in range(ROWS):
        for place in places(random, 2):
            old = arb(float(middle[row])) + arb(float(half[row])) * arb(place.x)
            for component in range(2):
                rest = float(random.choice([-1.0, 1.0]))
                before = member(models, (component, row), Place(old, place.e), rest)
                assert excess(result, (component, row), place, before) <= 1


def test_the_check_sees_a_substitution_without_its_rounding(monkeypatch):
    monkeypatch.setattr(under_test, "gamma", lambda n: 0.0)
    random = np.random.default_rng(0)
    models = random_models(random, (1,), 1.0, 2, 0.0)
    middle, half = np.array([0.3]), np.array([0.1])
    result = substitute(models, middle, half)
    place = Place(0.7, np.ones(2))
    old = arb(0.3) + arb(0.1) * arb(0.7)
    assert excess(result, (0,), place, member(models, (0,), Place(old, place.e))) > 1


@settings(max_examples=100)
@given(SEEDS)
def test_a_restricted_row_covers_its_part_and_says_so(seed):
    """Restricted again and again, the ends of the exact part stay within the rows."""
    random = np.random.default_rng(seed)
    c = np.zeros((TERMS, 4, 1))
    c[1] = 1.0  # the state is x itself
    rows = make_rows(Models(c, np.zeros((4, 1))))
    for depth in range(1, 30):
        low, high = inner(random, 1)
        before = rows
        rows = rows.restrict(low, high)
        new_middle, new_half = (arb(float(x)) for x in rows.state.c[:2, 0, 0])
        radius = arb(float(rows.state.radius[0, 0]))
        old_middle, old_half = (arb(float(x)) for x in before.state.c[:2, 0, 0])
        for end in (low, high):
            wanted = old_middle + old_half * arb(float(end[0]))
            assert new_middle - new_half - radius <= wanted <= new_middle + new_half + radius
        drift = 4 * depth * 2.0**-53 + 2.0**-40  # the row is made longer by a share of 2^-40
        assert abs(float(new_middle - new_half) - rows.low[0]) <= drift
        assert abs(float(new_middle + new_half) - rows.high[0]) <= drift


def contains(state: Models, row: int, place: Place, values: list[arb]) -> bool:
    """Tell whether a consolidated state holds a vector at x for some values of its symbols.

    That is a linear programme; here the state's frame is square and well conditioned, so the
    symbols are solved for and what is left over is compared with the radius.
    """
    k = state.symbols
    middle = [
        member(Models(state.c[:TERMS], state.radius), (i, row), Place(place.x, place.e[:0]))
        for i in range(len(values))
    ]
    off = np.array([float(v - m) for v, m in zip(values, middle, strict=True)])
    columns = state.c[TERMS::2, :, row].T + state.c[TERMS + 1 :: 2, :, row].T * place.x
    e = np.linalg.lstsq(columns, off, rcond=None)[0]
    e = np.clip(e, -1, 1)
    assert len(e) == k
    return bool((np.abs(off - columns @ e) <= state.radius[:, row] * (1 + 1e-3) + 1e-17).all())


@settings(max_examples=60)
@given(SEEDS, st.sampled_from([1e-6, 1e-2]), st.sampled_from([1, 3, 7]))
def test_gathered_errors_hold_every_vector_of_errors(seed, error, symbols):
    random = np.random.default_rng(seed)
    state = random_models(random, (4, ROWS), 0.1, symbols, error)
    state.c[TERMS:, V] = 0.0
    # Stretched, as errors are that were driven for a while.
    state.c[TERMS:, S] *= 10 ** random.uniform(-3, 0)
    state.c[TERMS + 1 :: 2] *= random.choice([0.0, 1.0])
    active = [S, F, THETA]
    result = consolidate(state, active)
    assert result.symbols == 3
    assert (result.c[:TERMS] == state.c[:TERMS]).all()
    assert (result.radius[V] == state.radius[V]).all()
    for row in range(ROWS):
        for place in places(random, symbols):
            rests = random.choice([-1.0, 1.0], 4)
            values = [member(state, (i, row), place, float(rests[i])) for i in range(4)]
            assert contains(result, row, place, values)


@settings(max_examples=40)
@given(SEEDS, st.sampled_from([[S, F, THETA], [S, F, V, THETA]]))
def test_gathered_errors_in_any_frame(seed, active):
    """A frame that is not orthogonal at all costs size, never soundness: QR is not trusted."""
    random = np.random.default_rng(seed)
    k = len(active)
    state = random_models(random, (4, ROWS), 0.1, 5, 1e-3)
    if k == 3:
        state.c[TERMS:, V] = 0.0
    bent = np.eye(k) + random.choice([0.0, 1e-9, 0.3]) * random.normal(size=(ROWS, k, k))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(np.linalg, "qr", lambda columns: (bent, None))
        result = consolidate(state, active)
    for row in range(ROWS):
        for place in places(random, 5):
            off = np.array(
                [
                    float(member(state, (i, row), place, 1.0) - member(
                        Models(state.c[:TERMS], state.radius), (i, row), Place(place.x, place.e[:0])
                    ))
                    for i in active
                ]
            )  # fmt: skip
            # The member that the proof names: e = Q (Q^T off), the rest within the radius.
            turned = bent[row].T @ off
            size = result.c[TERMS::2, active, row] + result.c[TERMS + 1 :: 2, active, row] * place.x
            extent = np.diag(size) / np.diag(bent[row])  # symbol i along column i of the frame
            assert (np.abs(turned) <= np.abs(extent) * (1 + 1e-12)).all()
            rest = np.abs(off - bent[row] @ turned)
            assert (rest <= result.radius[active, row] * (1 + 1e-9)).all()


def test_the_check_sees_a_frame_whose_lack_is_not_counted(monkeypatch):
    """Without the measured lack of orthogonality the bent frame's rest is too small."""
    monkeypatch.setattr(np, "eye", lambda k: np.broadcast_to(bent @ bent.T, (1, k, k)))
    bent = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.2], [0.1, 0.0, 1.0]])
    monkeypatch.setattr(np.linalg, "qr", lambda columns: (bent[None], None))
    c = np.zeros((TERMS + 6, 4, 1))
    c[TERMS::2, [S, F, THETA], 0] = 1e-3 * bent
    result = consolidate(Models(c, np.zeros((4, 1))), [S, F, THETA])
    off = 1e-3 * bent.sum(axis=0)
    rest = np.abs(off - bent @ (bent.T @ off))
    assert (rest > result.radius[[S, F, THETA], 0]).any()


@settings(max_examples=100)
@given(SEEDS)
@example(0)
def test_start_rows_cover_the_box(seed):
    random = np.random.default_rng(seed)
    lower = np.array([0.65, 9.9, 0.0, 0.0]) + random.normal(size=4) * random.choice([0.0, 1e3])
    upper = lower + random.choice([0.0, 1e-15, 0.1, 1.0], 4)
    lead = int(np.argmax(upper - lower))
    active = [S, F, V, THETA] if upper[V] > lower[V] else [S, F, THETA]
    rows = start_rows(Box(lower, upper, lead), active, np.array([-1.0]), np.array([1.0]))
    for corner in range(16):
        wanted = [upper[i] if corner >> i & 1 else lower[i] for i in range(4)]
        # A box is a product: each component must reach its end by x or a symbol of its own.
        for i in range(4):
            c = rows.state.c[:, i, 0]
            reach = sum((abs(arb(float(x))) for x in c[1:]), arb(float(rows.state.radius[i, 0])))
            assert abs(arb(float(wanted[i])) - arb(float(c[0]))) <= reach
    leading = rows.state.c[1:, :, 0] != 0
    assert (leading.sum(axis=1) <= 1).all()  # no two components share x or a symbol
    assert (leading.sum(axis=0) <= 1).all()


def test_halves_of_a_box_share_their_edge():
    box = Box(np.array([0.1, 9.9, 0.0, -0.3]), np.array([0.7, 9.9, 2.4, 0.1]), 0)
    for component in (0, 2, 3):
        first, second = box.halves(component)
        assert first.upper[component] == second.lower[component]
        assert first.lower.tolist() == box.lower.tolist()
        assert second.upper.tolist() == box.upper.tolist()
        assert first.lead == second.lead == 0


def test_start_rows_take_pieces():
    box = Box(np.array([0.65, 9.9, 0.0, 0.0]), np.array([0.85, 9.9, 0.0, 0.0]), S)
    low, high = np.array([-1.0, 0.5]), np.array([0.5, 1.0])
    rows = start_rows(box, [S, F, THETA], low, high)
    ends = rows.state.c[0, S] + np.array([[-1], [1]]) * rows.state.c[1, S]
    assert ends[0] == pytest.approx([0.65, 0.8], abs=1e-11)
    assert ends[1] == pytest.approx([0.8, 0.85], abs=1e-11)
    assert rows.low.tolist() == [-1.0, 0.5]
    assert rows.high.tolist() == [0.5, 1.0]


@settings(max_examples=60)
@given(SEEDS, st.sampled_from([0.0, 1e-9, 1e-3, 0.1]), st.sampled_from([0.0, 0.01, 0.3, 1.0]))
def test_cuts_cover_the_row(seed, error, curved):
    """Steep guards, flat ones, guards with a double root, guards that keep their sign."""
    random = np.random.default_rng(seed)
    guards = random_models(random, (8,), 0.3, 1, error, 0.3)
    guards.c[2:TERMS] *= curved
    guards.c[0, 3] = 0.0
    guards.c[:TERMS, 4] = [0.04, -0.4, 1.0, 0, 0, 0]  # (x - 0.2)^2
    guards.c[:TERMS, 5] = [1e-9, 0, 0, 0, 0, 0]
    both = parts(guards)
    for n in range(8):
        for place in [*places(random, 1), *(Place(x, np.ones(1)) for x in np.linspace(-1, 1, 41))]:
            for rest in (-1.0, 1.0):
                value = member(guards, (n,), place, rest)
                if not value < 0:
                    assert both.positive[0, n] <= place.x <= both.positive[1, n]
                if not value > 0:
                    assert both.negative[0, n] <= place.x <= both.negative[1, n]


def test_a_cut_at_a_sharp_root_is_narrow():
    guards = Models(np.array([[-0.3], [1.0], [0.1], [0.0], [0.0], [0.0]]), np.array([1e-9]))
    both = parts(guards)
    overlap = both.negative[1, 0] - both.positive[0, 0]
    assert 0 < overlap < 1e-8
    assert both.positive[1, 0] == 1.0
    assert both.negative[0, 0] == -1.0


def test_guards_of_one_sign_leave_the_other_part_empty():
    c = np.zeros((TERMS, 2))
    c[0], c[1] = [1.0, -1.0], 0.1
    both = parts(Models(c, np.full(2, 1e-3)))
    assert (both.positive[:, 0] == [-1, 1]).all()
    assert both.negative[0, 0] > both.negative[1, 0]
    assert (both.negative[:, 1] == [-1, 1]).all()
    assert both.positive[0, 1] > both.positive[1, 1]


@pytest.mark.parametrize("radius", [np.nan, np.inf])
def test_unknown_guards_leave_both_parts_whole(radius):
    """Else a row whose guard overflowed would vanish, and count as proved."""
    c = np.zeros((TERMS, 2))
    c[0] = [1.0, -1.0]
    both = parts(Models(c, np.full(2, radius)))
    for part in (both.positive, both.negative):
        assert (part == [[-1.0, -1.0], [1.0, 1.0]]).all()


def test_joined_rows_are_the_same_rows():
    random = np.random.default_rng(0)
    rows = make_rows(random_models(random, (4, 5), 0.1, 3, 1e-3))
    again = join(
        [rows.take(np.array([3, 1])), rows.take(np.array([True, False, True, False, True]))]
    )
    order = [3, 1, 0, 2, 4]
    assert (again.state.c == rows.state.c[..., order]).all()
    assert (again.state.radius == rows.state.radius[:, order]).all()
    assert error_spread(again.state).shape == (4, 5)


def test_gaps_between_rows_are_found():
    def gaps(low, high, *intervals):
        lows, highs = np.array(intervals).reshape(-1, 2).T
        found = uncovered(np.array(low), np.array(high), lows, highs)
        return np.stack(found, axis=1).tolist()

    assert gaps([-1.0], [1.0], (-1, 0), (0, 1)) == []
    assert gaps([-1.0], [1.0], (0, 1), (-1, 0.5)) == []
    assert gaps([-1.0], [1.0], (-1, 0), (0.5, 1)) == [[0, 0.5]]
    assert gaps([-1.0], [1.0]) == [[-1, 1]]
    assert gaps([-1.0, 0.5], [0.0, 1.0], (-1, 0), (0.5, 0.75)) == [[0.75, 1]]
    assert gaps([-1.0, 0.5], [0.0, 1.0], (-0.5, 0), (0.5, 1)) == [[-1, -0.5]]
    assert gaps([-0.5], [0.5], (-0.5, 0), (GAP / 2, 0.5)) == []
    assert gaps([-0.5], [0.5], (-0.5, 0), (3 * GAP, 0.5)) == [[0, 3 * GAP]]

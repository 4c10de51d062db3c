"""Rows: restriction, start boxes, and cuts lose no member."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from enclosed import rows_of
from exact_members import (
    OWN_ROUNDING,
    Place,
    arb,
    excess,
    member,
    places,
    products,
    random_models,
)  # fmt: skip
from hypothesis import example, given, settings
from hypothesis import strategies as st

from verifier import rows as under_test
from verifier.arithmetic import BASE, KNOWN
from verifier.cuts import parts
from verifier.models import TERMS, Models, cuttable, error_spread
from verifier.problem import Box, start_rows
from verifier.proof import GAP, uncovered
from verifier.rounding import U
from verifier.rows import Rows, S, join

SEEDS = st.integers(0, 2**32 - 1)
ROWS = 3


def inner(random: np.random.Generator, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return parts of [-1, 1]: any, halves, slivers at the ends."""
    low = random.uniform(-1, 1, rows)
    high = low + (1 - low) * random.random(rows) ** random.integers(1, 40)
    kind = random.integers(0, 4, rows)
    low = np.where(kind == 0, -1.0, np.where(kind == 1, 0.0, low))
    high = np.where(kind == 0, 0.0, np.where(kind == 1, 1.0, high))
    return low, np.maximum(low, high)


def identity() -> Rows:
    """Return a row whose state is x itself."""
    c = np.zeros((TERMS, 4, 1))
    c[1] = 1.0
    return rows_of(Models(c, np.zeros((4, 1))))


@settings(max_examples=100)
@given(SEEDS)
@example(3606)  # parts that are hardly smaller: what each adds to its ends, adds up
@example(0)
def test_a_restricted_row_covers_its_part_and_says_so(seed):
    """Restricted again and again, the ends of the exact part stay within the rows.

    Where the models say that the row ends is where its piece ends, up to the rounding that
    Prover.prove allows for: what is tried again after a failure is told by the pieces.
    """
    random = np.random.default_rng(seed)
    rows = identity()
    middle, half = arb(0), arb(1)
    for depth in range(1, 30):
        low, high = inner(random, 1)
        wanted = [middle + half * arb(float(end[0])) for end in (low, high)]
        rows = rows.restrict(low, high)
        # The row's x' stands for middle + half x' of the first row's, exactly.
        part_middle, part_half = under_test.middle_half(low, high)
        middle, half = middle + half * arb(float(part_middle[0])), half * arb(float(part_half[0]))
        assert middle - half <= wanted[0] + OWN_ROUNDING
        assert wanted[1] <= middle + half + OWN_ROUNDING
        for x in (-1.0, 0.3, 1.0):
            place = Place(x, np.zeros(0))
            assert excess(rows.state, (0, 0), place, middle + half * arb(x)) <= 1
        assert abs(middle - half - arb(float(rows.low[0]))) <= 8 * U * depth
        assert abs(middle + half - arb(float(rows.high[0]))) <= 8 * U * depth


def test_the_check_sees_pieces_that_do_not_grow_with_their_rows():
    """As it was: the pieces of parts without what is added to the models' half widths."""
    random = np.random.default_rng(3606)
    piece_low, piece_high, middle, half = -1.0, 1.0, arb(0), arb(1)
    worst = 0.0
    for depth in range(1, 30):
        low, high = inner(random, 1)
        part_middle, part_half = under_test.middle_half(low, high)
        middle, half = middle + half * arb(float(part_middle[0])), half * arb(float(part_half[0]))
        centre, width = (piece_high + piece_low) / 2, (piece_high - piece_low) / 2
        piece_low, piece_high = (float(centre + width * end[0]) for end in (low, high))
        off = abs(middle - half - arb(piece_low)).max(abs(middle + half - arb(piece_high)))
        worst = max(worst, float(off) / (8 * U * depth))
    assert worst > 10


def narrowed(random: np.random.Generator, error: float) -> list[float]:
    """Return by how much members, at their new places, exceed rows narrowed along a symbol."""
    symbols = int(random.choice([3, KNOWN + 3]))
    state = random_models(random, (4, ROWS), 0.1, symbols, error)
    rows = rows_of(state)
    symbol = random.choice(cuttable(symbols), ROWS)
    low, high = inner(random, ROWS)
    result = rows.narrow(symbol, low, high)
    assert (result.splits == rows.splits + 1).all()
    assert (result.low == -1).all()
    assert (result.high == 1).all()
    middle, half = under_test.middle_half(low, high)
    found = []
    for row in range(ROWS):
        for place in places(random, symbols):
            for end in (low[row], high[row], low[row] + 0.3 * (high[row] - low[row])):
                before = [arb(float(e)) for e in place.e]
                before[symbol[row]] = arb(float(end))
                after = [arb(float(e)) for e in place.e]
                after[symbol[row]] = (arb(float(end)) - arb(float(middle[row]))) / arb(
                    float(half[row])
                )
                assert abs(after[symbol[row]]) <= 1
                if symbols >= KNOWN:
                    before[BASE:KNOWN], after[BASE:KNOWN] = products(before), products(after)
                for i in range(4):
                    value = held(state, i, row, place.x, before) + arb(float(state.radius[i, row]))
                    off = abs(value - held(result.state, i, row, place.x, after))
                    radius = float(result.state.radius[i, row])
                    found.append(float(off / arb(radius)) if radius else float(off))
    return found


def held(state: Models, component: int, row: int, x: float, e: list[arb]) -> arb:
    """Return the polynomial and symbols of a state, exactly."""
    c = state.c[:, component, row]
    total = sum((arb(float(c[k])) * arb(x) ** k for k in range(TERMS)), arb(0))
    for j, value in enumerate(e):
        pair = arb(float(c[TERMS + 2 * j])) + arb(float(c[TERMS + 2 * j + 1])) * arb(x)
        total += pair * value
    return total


@settings(max_examples=40)
@given(SEEDS, st.sampled_from([1e-9, 1e-3, 0.1]))
def test_a_row_narrowed_along_a_symbol_covers_its_part(seed, error):
    assert max(narrowed(np.random.default_rng(seed), error)) <= 1


def test_the_check_sees_a_narrowing_without_its_rounding(monkeypatch):
    monkeypatch.setattr(under_test, "gamma", lambda n: 0.0)
    monkeypatch.setattr(under_test, "UP", 1.0)
    random = np.random.default_rng(0)
    seen = []
    for _ in range(10):
        random_state = random.integers(2**32)
        found = narrowed(np.random.default_rng(random_state), 0.1)
        seen.append(max(found))
    assert max(seen) > 1


def test_parts_of_a_gathered_row_may_stem_from_all_that_it_stems_from():
    """Its x says nothing of the start position."""
    rows = replace(rows_of(identity().state), gathered=np.array([True]), low=np.array([0.25]))
    part = rows.restrict(np.array([-1.0]), np.array([0.0]))
    assert (part.low[0], part.high[0]) == (0.25, 1.0)
    assert part.state.c[0, S, 0] == pytest.approx(-0.5)
    assert part.state.c[1, S, 0] == pytest.approx(0.5)
    assert part.splits[0] == 1


@settings(max_examples=100)
@given(SEEDS)
@example(0)
def test_start_rows_cover_the_box(seed):
    random = np.random.default_rng(seed)
    lower = np.array([0.65, 9.9, 0.0, 0.0]) + random.normal(size=4) * random.choice([0.0, 1e3])
    upper = lower + random.choice([0.0, 1e-15, 0.1, 1.0], 4)
    box = Box(lower, upper, int(np.argmax(upper - lower)))
    carried = random.integers(0, 5)
    rows = start_rows(box, np.array([-1.0]), np.array([1.0]), carried=carried)
    assert rows.state.symbols == max(carried, len(box.others)) + 3
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


def test_start_rows_take_pieces():
    box = Box(np.array([0.65, 9.9, 0.0, 0.0]), np.array([0.85, 9.9, 0.0, 0.0]), S)
    low, high = np.array([-1.0, 0.5]), np.array([0.5, 1.0])
    rows = start_rows(box, low, high, case=3)
    ends = rows.state.c[0, S] + np.array([[-1], [1]]) * rows.state.c[1, S]
    assert ends[0] == pytest.approx([0.65, 0.8], abs=1e-11)
    assert ends[1] == pytest.approx([0.8, 0.85], abs=1e-11)
    assert (rows.low <= low).all()
    assert (rows.high >= high).all()
    assert rows.low == pytest.approx(low, abs=1e-11)
    assert rows.high == pytest.approx(high, abs=1e-11)
    assert rows.case.tolist() == [3, 3]
    assert not rows.gathered.any()


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
    rows = rows_of(random_models(random, (4, 5), 0.1, 3, 1e-3))
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

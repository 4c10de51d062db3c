"""The two sides of a guard: every member of a row lies in one that allows its sign."""

from __future__ import annotations

import numpy as np
import pytest
from exact_members import Place, member, places, random_models
from hypothesis import example, given, settings
from hypothesis import strategies as st

from verifier import sides as under_test
from verifier.models import TERMS, Models
from verifier.sides import Sides, sides

SEEDS = st.integers(0, 2**32 - 1)
COUNT = 8


def guards_of(random: np.random.Generator, error: float) -> Models:
    """Return guards that x decides, that a symbol decides, and that several symbols decide."""
    guards = random_models(random, (COUNT,), 0.3, 3, error, 0.1)
    guards.c[1:TERMS, : COUNT // 2] *= 1e-3
    guards.c[TERMS : TERMS + 2, : COUNT // 4] *= 100
    guards.c[TERMS + 1 :: 2] *= random.choice([0.0, 0.1, 3.0])  # 3: signs of symbols are open
    guards.c[0, ::3] = 0.0
    return guards


def lost(guards: Models, both: Sides, random: np.random.Generator) -> int:
    """Count members that are not in a side that their sign allows."""
    count = 0
    for n in range(COUNT):
        parameter = int(both.parameter[n])
        for place in [*places(random, 3), *_near_the_ends(both, n, random)]:
            at = place.x if parameter == 0 else float(place.e[parameter - 1])
            for rest in (-1.0, 1.0):
                value = member(guards, (n,), place, rest)
                for sign, (low, high) in (
                    (not value < 0, both.positive[:, n]),
                    (not value > 0, both.negative[:, n]),
                ):
                    count += bool(sign and not low <= at <= high)
    return count


def _near_the_ends(both: Sides, n: int, random: np.random.Generator) -> list[Place]:
    """Return places just outside of the sides: what lies there must not need them."""
    found = []
    for end in (both.positive[0, n], both.positive[1, n], both.negative[0, n], both.negative[1, n]):
        for off in (-1e-12, 1e-12, -1e-3, 1e-3):
            at = float(np.clip(end + off, -1, 1))
            for _ in range(4):
                e, x = random.choice([-1.0, 1.0], 3), float(random.choice([-1.0, 1.0]))
                if both.parameter[n]:
                    e[both.parameter[n] - 1] = at
                else:
                    x = at
                found.append(Place(x, e))
    return found


@settings(max_examples=20)
@given(SEEDS, st.sampled_from([1e-9, 1e-3, 0.1, 1.0]))
@example(1, 1.0)
def test_every_member_lies_in_a_side_of_its_sign(seed, error):
    random = np.random.default_rng(seed)
    guards = guards_of(random, error)
    both = sides(guards, wide=True)
    assert lost(guards, both, random) == 0
    assert (sides(guards, wide=False).parameter == 0).all()


def test_symbols_decide_where_they_are_what_counts():
    """0.1 + (1 + 0.2 x) e0 + 0.05 e1: negative only for e0 <= (-0.1 + 0.05) / (1 +- 0.2)."""
    c = np.zeros((TERMS + 4, 1))
    c[0], c[TERMS], c[TERMS + 1], c[TERMS + 2] = 0.1, 1.0, 0.2, 0.05
    both = sides(Models(c, np.zeros(1)), wide=True)
    assert both.parameter.tolist() == [1]
    # Positive as soon as 0.15 + 0.8 e0 >= 0, negative as long as 0.05 + 1.2 e0 <= 0.
    assert both.positive[:, 0] == pytest.approx([-0.15 / 0.8, 1], abs=1e-8)
    assert both.negative[:, 0] == pytest.approx([-1, -0.05 / 1.2], abs=1e-8)
    assert both.larger[0] == pytest.approx(1 + 0.15 / 0.8, abs=1e-8)
    assert both.overlap[0] == pytest.approx(0.15 / 0.8 - 0.05 / 1.2, abs=1e-8)


def test_a_falling_symbol_swaps_the_sides():
    c = np.zeros((TERMS + 2, 1))
    c[0], c[TERMS] = 0.5, -1.0
    both = sides(Models(c, np.zeros(1)), wide=True)
    assert both.positive[:, 0] == pytest.approx([-1, 0.5], abs=1e-8)
    assert both.negative[:, 0] == pytest.approx([0.5, 1], abs=1e-8)
    assert 0 < both.overlap[0] < 1e-8


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("place", [0, 1, TERMS, TERMS + 1, None])
def test_unknown_guards_leave_both_sides_whole(bad, place):
    """Else a row whose guard overflowed would vanish, and count as proved."""
    c, radius = np.zeros((TERMS + 2, 2)), np.full(2, 1e-3)
    c[0], c[TERMS] = [1.0, -1.0], 0.5
    if place is None:
        radius[:] = bad
    else:
        c[place] = bad
    with np.errstate(invalid="ignore"):
        both = sides(Models(c, radius), wide=True)
    for side in (both.positive, both.negative):
        assert (side == [[-1.0, -1.0], [1.0, 1.0]]).all()


def test_the_check_sees_ends_that_forget_the_other_symbols(monkeypatch):
    original = under_test.norm

    def norm(c):
        return 0.9 * original(c)

    random = np.random.default_rng(3)
    seen = []
    for _ in range(10):
        guards = guards_of(random, 0.1)
        assert lost(guards, sides(guards, wide=True), random) == 0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(under_test, "norm", norm)
            patch.setattr(under_test, "SLACK", 0.0)
            seen.append(lost(guards, sides(guards, wide=True), random))
    assert sum(seen) > 0


def test_sides_at_an_index():
    random = np.random.default_rng(0)
    both = sides(guards_of(random, 0.1), wide=True)
    some = both.take(np.array([3, 1]))
    assert some.parameter.tolist() == both.parameter[[3, 1]].tolist()
    assert (some.larger == both.larger[[3, 1]]).all()
    assert (some.overlap == both.overlap[[3, 1]]).all()

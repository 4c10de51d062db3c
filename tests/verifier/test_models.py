"""Arithmetic of Taylor models: results hold the exact result of every member."""

from __future__ import annotations

import numpy as np
import pytest
from exact_members import Place, arb, excess, member, places, random_models, worst_excess
from hypothesis import given, settings
from hypothesis import strategies as st

from verifier import arithmetic
from verifier import models as under_test
from verifier.models import (
    TERMS,
    Models,
    bounds,
    constant,
    error_spread,
    linear,
    multiply,
    spread,
    stack,
    substitute,
)

SEEDS = st.integers(0, 2**32 - 1)
WIDTHS = st.sampled_from([0.0, 1e-12, 1e-6, 1e-2, 1.0, 1e3])
ERRORS = st.sampled_from([0.0, 1e-15, 1e-6, 1e-1])
CENTRES = st.sampled_from([0.0, 1e-3, 1.0, 1e6])
ROWS = 4


def two(seed, width, error, centre, symbols=3):
    random = np.random.default_rng(seed)
    a = random_models(random, (ROWS,), width, symbols, error, centre)
    b = random_models(random, (ROWS,), 10 ** random.uniform(-8, 1), symbols, error, 1.0)
    return random, a, b


@settings(max_examples=60)
@given(SEEDS, WIDTHS, ERRORS, CENTRES)
def test_sums_and_differences(seed, width, error, centre):
    random, a, b = two(seed, width, error, centre)
    assert worst_excess([a, b], a + b, lambda x, y: x + y, random) <= 1
    assert worst_excess([a, b], a - b, lambda x, y: x - y, random) <= 1


@settings(max_examples=60)
@given(SEEDS, WIDTHS, ERRORS, CENTRES, st.sampled_from([0.1, -3.7, 1e-9, 0.0, 1e5]))
def test_constants_and_factors(seed, width, error, centre, factor):
    random, a, _ = two(seed, width, error, centre)
    assert worst_excess([a], a.plus(factor), lambda x: x + factor, random) <= 1
    assert worst_excess([a], a.times(factor), lambda x: x * factor, random) <= 1
    assert worst_excess([a], -a, lambda x: -x, random) <= 1
    wide = a.widen(0.1)
    assert worst_excess([a], wide, lambda x: x + 0.1, random) <= 1
    assert worst_excess([a], wide, lambda x: x - 0.1, random) <= 1


@settings(max_examples=100)
@given(SEEDS, WIDTHS, ERRORS, CENTRES, st.sampled_from([0, 1, 3, 9, 12]))
def test_products(seed, width, error, centre, symbols):
    random, a, b = two(seed, width, error, centre, symbols)
    assert worst_excess([a, b], multiply(a, b), lambda x, y: x * y, random) <= 1
    assert worst_excess([a, a], a * a, lambda x, y: x * y, random) <= 1


def test_a_product_with_a_model_that_has_no_symbols():
    random, a, b = two(0, 0.1, 1e-3, 1.0)
    short = Models(b.c[:TERMS], b.radius)

    def exact(x, y):
        return x * y

    def padded(models: Models) -> Models:
        c = np.zeros_like(a.c)
        c[: len(models.c)] = models.c
        return Models(c, models.radius)

    assert worst_excess([a, padded(short)], a * short, exact, random) <= 1
    assert worst_excess([padded(short), a], short * a, exact, random) <= 1


def test_products_of_short_models_are_no_larger_than_they_need_be():
    """What is lost at degree 5 of (1 + x)(1 + x) is rounding only."""
    c = np.zeros((TERMS, 1))
    c[:2] = 1.0
    square = multiply(Models(c, np.zeros(1)), Models(c, np.zeros(1)))
    assert square.c[:3, 0].tolist() == [1.0, 2.0, 1.0]
    assert square.radius[0] < 1e-13


def test_the_check_sees_a_product_without_its_rounding(monkeypatch):
    monkeypatch.setattr(arithmetic, "gamma", lambda n: 0.0)
    random = np.random.default_rng(0)
    a, b = random_models(random, (ROWS,), 1e-10), random_models(random, (ROWS,), 1e-10)
    assert worst_excess([a, b], multiply(a, b), lambda x, y: x * y, random) > 1


def test_the_check_sees_a_sum_without_its_rounding(monkeypatch):
    monkeypatch.setattr(arithmetic, "U", 0.0)
    random, a, b = two(1, 0.1, 0.0, 1.0)
    assert worst_excess([a, b], a + b, lambda x, y: x + y, random) > 1


@pytest.mark.parametrize("error", [0.0, 1e-2])
def test_the_check_sees_a_product_cut_off_ten_times_too_small(error):
    """The radius of a product of members at their extremes is filled to more than a tenth."""
    worst = 0.0
    for seed in range(40):
        random, a, b = two(seed, 1.0, error, 0.0)
        worst = max(worst, worst_excess([a, b], multiply(a, b), lambda x, y: x * y, random))
    assert 0.1 < worst <= 1


def matrix(seed, width, error, out, inputs, rows=3):
    random = np.random.default_rng(seed)
    weights = random.normal(size=(out, inputs)).astype(np.float32).astype(float)
    a = random_models(random, (inputs, rows), width, 2, error, 2.5)
    return random, weights, a


def worst_linear(random, weights, a, result) -> float:
    worst = 0.0
    for row in range(a.radius.shape[1]):
        for place in places(random, a.symbols)[:3]:
            for out, w in enumerate(weights):
                # Every input at the end of its radius that is worst for this output.
                value = arb(0)
                for i, factor in enumerate(w):
                    rest = float(np.sign(factor))
                    value += arb(float(factor)) * member(a, (i, row), place, rest)
                worst = max(worst, excess(result, (out, row), place, value))
    return worst


@settings(max_examples=15)
@given(SEEDS, WIDTHS, ERRORS, st.sampled_from([1, 7, 64]))
def test_linear_maps(seed, width, error, inputs):
    random, weights, a = matrix(seed, width, error, 3, inputs)
    assert worst_linear(random, weights, a, linear(weights, np.abs(weights), a)) <= 1


def test_the_check_sees_a_linear_map_without_its_rounding(monkeypatch):
    monkeypatch.setattr(under_test, "gamma", lambda n: 0.0)
    random, weights, a = matrix(0, 0.1, 0.0, 3, 64)
    assert worst_linear(random, weights, a, linear(weights, np.abs(weights), a)) > 1


def test_the_check_sees_a_linear_map_that_loses_a_little_radius():
    random, weights, a = matrix(0, 0.1, 1e-3, 3, 64)
    result = linear(weights, np.abs(weights), a)
    assert worst_linear(random, weights, a, Models(result.c, result.radius * 0.99)) > 1


def test_a_very_wide_linear_map_covers_the_rounding_of_its_own_radius():
    """More than 2^13 inputs: the sum of radii errs by more than UP covers."""
    _random, weights, a = matrix(3, 0.0, 1e-3, 1, 20_000, 1)
    result = linear(weights, np.abs(weights), a)
    exact = sum(
        (
            arb(float(abs(w))) * arb(float(r))
            for w, r in zip(weights[0], a.radius[:, 0], strict=True)
        ),
        arb(0),
    )
    assert arb(float(result.radius[0, 0])) >= exact


@settings(max_examples=60)
@given(SEEDS, WIDTHS, ERRORS, CENTRES)
def test_bounds_hold_all_members(seed, width, error, centre):
    random, a, _ = two(seed, width, error, centre)
    low, high = bounds(a)
    stray, errors = spread(a), error_spread(a)
    for row in range(ROWS):
        for place in places(random, a.symbols):
            for rest in (-1.0, 1.0):
                value = member(a, (row,), place, rest)
                assert arb(float(low[row])) <= value <= arb(float(high[row]))
                assert abs(value - arb(float(a.c[0, row]))).mid() <= arb(float(stray[row]))
                alone = Models(a.c[:TERMS], np.zeros(ROWS))
                middle = member(alone, (row,), Place(place.x, place.e[:0]))
                assert abs(value - middle).mid() <= arb(float(errors[row]))


def test_bounds_are_reached():
    """x and e at their ends: 1 + 2 x + 3 x^2 + (4 + 5 x) e + 6, at x = e = 1; e = -1 below."""
    c = np.zeros((TERMS + 2, 1))
    c[:3, 0], c[TERMS:, 0] = [1, 2, 3], [4, 5]
    low, high = bounds(Models(c, np.array([6.0])))
    assert high[0] == pytest.approx(21, abs=1e-10)
    # Below, the even power is at least 0 and the rest at its least.
    assert low[0] == pytest.approx(1 - 2 - 9 - 6, abs=1e-10)


def test_infinite_and_unknown_models_have_no_finite_bounds():
    c = np.zeros((TERMS, 3))
    c[0] = [1.0, np.nan, np.inf]
    with np.errstate(invalid="ignore"):
        low, high = bounds(Models(c, np.array([np.inf, 1.0, 1.0])))
    assert low[0] == -np.inf
    assert high[0] == np.inf
    assert not (low[1:] > -np.inf).any()


def test_constants_and_stacks():
    a = constant(np.array([0.1, 0.2]), 2)
    assert a.c.shape == (TERMS + 4, 2)
    assert a.symbols == 2
    assert not a.radius.any()
    both = stack([a, a.times(2.0)])
    assert both.c.shape == (TERMS + 4, 2, 2)
    assert both[1].c[0].tolist() == [0.2, 0.4]


def test_indices_mean_what_they_mean_in_numpy():
    a = random_models(np.random.default_rng(0), (3, 5), 1.0, 2, 1e-3)
    some = np.array([True, False, True, True, False])
    for index in (
        1, (1, 2), (slice(0, 2), slice(1, None)), (slice(None), np.array([3, 0, 3])),
        (2, np.array([4, 1])), (slice(None), some), (slice(None), np.arange(5)), (None, 1),
        (np.array([0, 2]), np.array([1, 3])), (slice(None), np.zeros(0, dtype=int)),
    ):  # fmt: skip
        found, full = a[index], index if isinstance(index, tuple) else (index,)
        assert np.array_equal(found.c, a.c[(slice(None), *full)])
        assert np.array_equal(found.radius, a.radius[full])
    assert a[:, np.array([3, 0])].c.flags.c_contiguous


def narrowed(random: np.random.Generator, a: Models) -> list[float]:
    """Return by how much members, found at their new places, exceed the narrowed models."""
    low = random.uniform(-1, 1, ROWS)
    high = low + (1 - low) * random.random(ROWS) ** random.integers(1, 40)
    middle, half = (low + high) / 2, (high - low) / 2
    result, found = substitute(a, middle, half), []
    for row in range(ROWS):
        for place in places(random, a.symbols):
            old = arb(float(middle[row])) + arb(float(half[row])) * arb(place.x)
            for component in range(2):
                before = member(a, (component, row), Place(old, place.e), 1.0)
                found.append(excess(result, (component, row), place, before))
    return found


@settings(max_examples=60)
@given(SEEDS, WIDTHS, ERRORS, st.sampled_from([0, 2, 4]))
def test_substitution_keeps_every_member(seed, width, error, symbols):
    random = np.random.default_rng(seed)
    a = random_models(random, (2, ROWS), width, symbols, error)
    assert max(narrowed(random, a)) <= 1


def test_the_check_sees_a_substitution_without_its_rounding(monkeypatch):
    monkeypatch.setattr(arithmetic, "gamma", lambda n: 0.0)
    random = np.random.default_rng(0)
    assert max(narrowed(random, random_models(random, (2, ROWS), 1.0, 2, 0.0))) > 1

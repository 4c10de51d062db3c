"""exp, tanh, sin and cos at points, against Arb at 200 bits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from exact_members import arb
from hypothesis import example, given
from hypothesis import strategies as st

from verifier.elementary import (
    SIN_COS_ERROR,
    SIN_COS_RANGE,
    TANH_ERROR,
    exp_negative,
    sin_cos,
    tanh_pair,
)
from verifier.rounding import TINY, UP, U, gamma

UNIT = arb(U)


def relative(found: float, exact: arb) -> arb:
    return abs(arb(float(found)) / exact - 1)


def spread_out(highest: float, count: int, seed: int = 0) -> np.ndarray:
    """Return positive numbers of all sizes up to ``highest``, and both sides of powers of 2."""
    random = np.random.default_rng(seed)
    powers = 2.0 ** np.arange(-30, math.log2(highest))
    near = np.concatenate([np.nextafter(powers, 0), powers, np.nextafter(powers, np.inf)])
    return np.concatenate(
        [
            highest * random.random(count),
            highest * 10 ** random.uniform(-20, 0, count),
            random.random(count),
            near,
        ]
    )


def test_exp_errs_by_less_than_is_stated():
    x = -np.concatenate([spread_out(700, 3000), math.log(2) * np.arange(0, 1000) / 2])
    found = exp_negative(x)
    worst = max(relative(y, arb(float(z)).exp()) for z, y in zip(x, found, strict=True))
    assert worst < 16 * UNIT
    assert worst > UNIT / 2  # the check can see an error of one rounding


def test_exp_is_exact_at_zero_and_tiny_far_below():
    assert exp_negative(np.array([0.0, -0.0])).tolist() == [1.0, 1.0]
    assert (exp_negative(np.array([-701.0, -1e300, -np.inf])) < 2.0**-1000).all()


def test_tanh_and_its_slope_err_by_less_than_is_stated():
    x = np.concatenate([spread_out(20, 3000, 1), spread_out(349, 500, 2), [0.17, 350.0]])
    x = np.concatenate([x, np.nextafter(0.17, [0, 1])])
    for sign in (1, -1):
        value, slope = tanh_pair(sign * x)
        for z, v, q in zip(sign * x, value, slope, strict=True):
            t, cosh = arb(float(z)).tanh(), arb(float(z)).cosh()
            assert relative(v, t) < arb(TANH_ERROR)
            assert relative(q, 1 / cosh**2) < arb(TANH_ERROR)


def test_the_slope_of_tanh_is_an_upper_bound_far_out_and_nothing_beside_the_radius():
    value, slope = tanh_pair(np.array([351.0, 1e6, 1e300, -1e300]))
    assert value.tolist() == [1.0, 1.0, 1.0, -1.0]
    assert (slope > 0).all()
    assert (slope < TINY).all()


def test_tanh_at_zero():
    value, slope = tanh_pair(np.array([0.0, -0.0]))
    assert value.tolist() == [0.0, 0.0]
    assert slope.tolist() == [1.0, 1.0]


def test_sin_and_cos_err_by_less_than_is_stated():
    random = np.random.default_rng(3)
    quarter = math.pi / 2 * np.arange(-636, 637)
    x = np.concatenate(
        [
            random.uniform(-SIN_COS_RANGE, SIN_COS_RANGE, 3000),
            random.uniform(-4, 4, 3000),
            spread_out(1.0, 500, 4),
            quarter,
            np.nextafter(quarter, -np.inf),
            quarter + math.pi / 4,
            [-SIN_COS_RANGE, SIN_COS_RANGE],
        ]
    )
    worst = arb(0)
    for z, s, c in zip(x, *sin_cos(x), strict=True):
        sine, cosine = arb(float(z)).sin_cos()
        worst = max(worst, abs(arb(float(s)) - sine), abs(arb(float(c)) - cosine))
    assert worst < arb(SIN_COS_ERROR)
    assert worst > UNIT / 2


@given(st.floats(-350, 350))
@example(5e-324)
@example(-(2.0**-1030))
def test_tanh_anywhere(x):
    value, slope = tanh_pair(np.array([x]))
    assert abs(arb(float(value[0])) - arb(x).tanh()) <= arb(TANH_ERROR) * abs(arb(x).tanh()) + TINY
    assert relative(slope[0], 1 / arb(x).cosh() ** 2) < arb(TANH_ERROR)


@given(st.floats(-SIN_COS_RANGE, SIN_COS_RANGE))
def test_sin_and_cos_anywhere(x):
    sine, cosine = sin_cos(np.array([x]))
    assert abs(arb(float(sine[0])) - arb(x).sin()) < arb(SIN_COS_ERROR)
    assert abs(arb(float(cosine[0])) - arb(x).cos()) < arb(SIN_COS_ERROR)


def test_nan_stays_nan():
    nan = np.array([np.nan])
    with np.errstate(invalid="ignore"):
        results = [exp_negative(nan), *tanh_pair(nan), *sin_cos(nan)]
    assert all(np.isnan(r[0]) for r in results)


@pytest.mark.parametrize("n", [1, 10, 1081, 10**6])
def test_gamma_is_an_upper_bound(n):
    exact = arb(n) * UNIT / (1 - arb(n) * UNIT)
    assert arb(gamma(n)) >= exact
    assert arb(gamma(n)) <= exact * arb(1 + 1e-5)


def test_up_covers_a_thousand_roundings_of_positive_numbers():
    random = np.random.default_rng(5)
    terms = random.random((1023, 50)) * 10 ** random.uniform(-10, 10, (1023, 50))
    total = np.zeros(50)
    for term in terms:  # worst for the rounding: one after the other
        total += term
    for column, found in zip(terms.T, total, strict=True):
        exact = sum((arb(float(t)) for t in column), arb(0))
        assert arb(float(found * UP)) >= exact

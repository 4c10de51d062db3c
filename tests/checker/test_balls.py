"""Ball arithmetic on doubles, against exact fractions and Arb."""

from __future__ import annotations

import operator
from fractions import Fraction

import numpy as np
import pytest
from flint import arb, fmpq
from hypothesis import example, given
from hypothesis import strategies as st

from checker import balls
from checker.balls import Balls

#: Of every size, underflow included.
NUMBERS = st.one_of(
    st.floats(-1e100, 1e100, allow_nan=False),
    st.floats(-2, 2, allow_nan=False),
    st.floats(-1e-300, 1e-300, allow_nan=False),
)
RADII = st.one_of(st.just(0.0), st.floats(0, 1e-9), st.floats(0, 1.0), st.floats(0, 1e-310))
SHARES = st.sampled_from([Fraction(-1), Fraction(1), Fraction(0), Fraction(1, 3)])
BALL = st.tuples(NUMBERS, RADII)


def one(ball: tuple[float, float]) -> Balls:
    middle, radius = ball
    return Balls(np.array([middle]), np.array([radius]))


def member(ball: tuple[float, float], share: Fraction) -> Fraction:
    """Return a real number in a ball."""
    return Fraction(ball[0]) + share * Fraction(ball[1])


def contains(found: Balls, value: Fraction) -> bool:
    radius = float(found.radius.ravel()[0])
    if radius == np.inf:
        return True
    return abs(value - Fraction(float(found.middle.ravel()[0]))) <= Fraction(radius)


@pytest.mark.parametrize("name", ["add", "subtract", "multiply"])
@given(BALL, BALL, SHARES, SHARES)
def test_operations_contain_the_exact_result(name, x, y, s, t):
    found = getattr(balls, name)(one(x), one(y))
    exact = {"add": operator.add, "subtract": operator.sub, "multiply": operator.mul}[name]
    assert contains(found, exact(member(x, s), member(y, t)))


@given(BALL, SHARES, st.integers(1, 1000))
def test_quotients_by_numbers_contain_the_exact_result(x, s, n):
    assert contains(balls.over(one(x), -n), -member(x, s) / n)


@given(BALL, BALL, SHARES)
@example((1.0, 9e-311), (0.0, 0.0), Fraction(1))
def test_bounds_are_bounds(x, y, s):
    value = member(x, s)
    assert balls.lower(one(x))[0] <= value <= balls.upper(one(x))[0]
    assert abs(value) <= Fraction(float(balls.size(one(x))[0]))
    assert contains(balls.hull(one(x), one(y)), value)
    assert contains(balls.hull(one(y), one(x)), value)
    if 0 <= value <= 1:
        assert contains(balls.clip(one(x), 0.0, 1.0), value)


@given(st.integers(0, 2**32), st.integers(1, 150), st.sampled_from([1.0, 1e-160, 1e80]))
def test_products_with_a_matrix_contain_the_exact_product(seed, n, scale):
    """Also where all but rounding cancels."""
    random = np.random.default_rng(seed)
    matrix = random.normal(size=(1, n)).astype(np.float32).astype(float)
    x = Balls(scale * random.normal(size=(n, 1)), scale * 1e-9 * random.uniform(size=(n, 1)))
    if n > 1:
        x.middle[-1] = -(matrix[0, :-1] @ x.middle[:-1, 0]) / matrix[0, -1]
    shares = [Fraction(int(k)) for k in random.choice([-1, 1], n)]
    terms = zip(x.middle[:, 0].tolist(), x.radius[:, 0].tolist(), shares, strict=True)
    values = [member((m, r), s) for m, r, s in terms]
    weights = map(Fraction, matrix[0].tolist())
    found = balls.product(matrix, x)
    assert contains(found, sum((w * v for w, v in zip(weights, values, strict=True)), Fraction(0)))
    weight = np.abs(matrix)
    bound = 1.000001 * weight @ x.radius + 1e-13 * weight @ np.abs(x.middle)
    assert found.radius[0, 0] <= bound[0, 0] + 1e-290


@given(NUMBERS, st.floats(-0.02, 0.02), st.integers(-650, 650))
def test_tanh_contains_the_exact_value(y, off, place):
    for x in (y, place / 32, place / 32 + off, place / 64):
        found = balls.tanh(np.array([x]))
        ball = arb(float(found.middle[0])) + arb(0, float(found.radius[0]))
        assert abs(arb(x).tanh() - float(found.middle[0])) <= float(found.radius[0])
        assert ball.contains(arb(x).tanh())
        assert found.radius[0] <= 2e-15


@pytest.mark.parametrize("x", [np.inf, -np.inf, 1e308, -25.0, 20.0, -20.0])
def test_tanh_of_large_numbers_is_a_sign(x):
    found = balls.tanh(np.array([x]))
    assert abs(found.middle[0] - np.sign(x)) <= 2e-16
    assert found.radius[0] >= 2e-17


def test_tanh_of_no_number_is_not_bounded():
    assert balls.tanh(np.array([np.nan])).radius[0] == np.inf


@given(BALL, SHARES)
def test_tanh_of_balls_contains_all_values(x, s):
    found = balls.tanh_between(one(x))
    value = member(x, s)
    exact = (arb(fmpq(value.numerator, value.denominator))).tanh()
    off = abs(exact - float(found.middle[0]))
    assert off.lower() <= float(found.radius[0])


@given(st.integers(0, 2**32))
def test_balls_of_arb_and_back_contain_what_they_come_from(seed):
    random = np.random.default_rng(seed)
    values = [arb(float(random.normal())) / 3 + arb(0, float(random.uniform())) for _ in range(6)]
    middle = balls.from_arb(values, (6,))
    for before, after in zip(values, balls.to_arb(middle), strict=True):
        assert after.contains(before)

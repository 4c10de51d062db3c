"""Functions along polynomials, in doubles: against exact values."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from flint import arb, arb_poly
from hypothesis import given
from hypothesis import strategies as st

from checker import balls, batch
from checker.balls import Balls, exact, multiply
from checker.models import TERMS
from checker.series import Series, by_division, by_taylor, range_of_powers

SEEDS = st.integers(0, 2**32)
SCALES = st.sampled_from([1.0, -3.0, 1e-6, -1e9, 1e-30])
#: Of the coefficients of x ... x^5, by the constant's: where 1 / p is nearly linear, and far from.
SIZES = st.sampled_from([0.0, 1e-12, 1e-6, 0.01, 0.3, 0.9])
PLACES = [-1.0, 1.0, -0.5, 0.75, 1e-3]


def over(y: Balls, n: int) -> list[Balls]:
    g = [balls.reciprocal(y)]
    while len(g) <= n:
        g.append(multiply(g[-1], balls.negative(g[0])))
    return g


def coefficients(seed: int, scale: float, size: float) -> list[float]:
    random = np.random.default_rng(seed)
    free = random.uniform(-1, 1, TERMS - 1) * 0.6 ** np.arange(TERMS - 1)
    share = size * free / np.abs(free).sum() * random.choice([0, 1], TERMS - 1, p=[0.2, 0.8])
    return [scale, *(scale * share).tolist()]


def holds(ball: arb, value: arb) -> bool:
    """Tell whether a ball of doubles surely contains a value, which is known but for 2^-1200."""
    return bool(abs(value - ball.mid()) <= ball.rad() + arb(2) ** -1200)


@pytest.fixture
def precise():
    from flint import ctx

    before, ctx.prec = ctx.prec, 1500
    yield
    ctx.prec = before


@pytest.mark.usefixtures("precise")
@pytest.mark.parametrize("rule", [by_division, by_taylor])
def test_reciprocals_along_polynomials_contain_their_values(rule):
    @given(SEEDS, SCALES, SIZES)
    def check(seed, scale, size):
        c = coefficients(seed, scale, size)
        p = arb_poly(c)
        with np.errstate(all="ignore"):
            found: Series = rule([exact(np.array([x])) for x in c], over)
        (left,), (within,), (second,) = map(balls.to_arb, (found.left, found.within, found.second))
        orders = [balls.to_arb(x)[0] for x in found.orders]
        s = 1 / arb(c[0])
        t = -s * s * c[1]
        for x in map(arb, PLACES):
            lacks = 1 / p(x) - sum((z.mid() * x**k for k, z in enumerate(orders)), arb(0))
            free = left.rad() + sum((z.rad() for z in orders), arb(0))
            assert abs(lacks - left.mid()) <= free
            assert holds(within, p(x))
            bend = ((1 / p(x)) ** 2 - s * s - 2 * s * t * x) / (x * x)
            assert abs(bend) <= abs(second.mid()) + second.rad()
        for k, g in enumerate(found.near[:3]):
            assert holds(balls.to_arb(g)[0], (-1) ** k * s ** (k + 1))

    check()


@given(SEEDS, SIZES)
def test_division_leaves_no_more_than_taylor_s_theorem(seed, size):
    p = [exact(np.array([x])) for x in coefficients(seed, 2.0, min(size, 0.7))]
    a, b = (rule(p, over) for rule in (by_division, by_taylor))
    stray = [x.left.radius + sum(c.radius for c in x.orders) for x in (a, b)]
    assert stray[0] <= 1.001 * stray[1] + 1e-15
    assert balls.size(a.second) <= 1.5 * balls.size(b.second) + 1e-15


@given(SEEDS, SCALES, SIZES)
def test_ranges_of_polynomials_contain_their_values(seed, scale, size):
    c = coefficients(seed, scale, size)
    found = range_of_powers([np.array(x) for x in c])
    middle, radius = Fraction(float(found.middle)), Fraction(float(found.radius))
    for x in map(Fraction, PLACES):
        value = sum(Fraction(z) * x**k for k, z in enumerate(c))
        assert abs(value - middle) <= radius


@given(SEEDS, st.integers(1, 40), st.integers(1, 3))
def test_sums_are_bounded(seed, count, parts):
    random = np.random.default_rng(seed)
    terms = [10.0 ** random.uniform(-20, 3, (2, count)) for _ in range(parts)]
    terms[0][0] = 5e-324
    for row, bound in enumerate(batch.upper_sum(terms).tolist()):
        exact_sum = sum(Fraction(x) for term in terms for x in term[row].tolist())
        assert exact_sum <= Fraction(bound) <= exact_sum * (1 + Fraction(1, 2**40)) + 1

"""The checker's arithmetic, against exact evaluation of random members."""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb
from hypothesis import given
from hypothesis import strategies as st

from checker import models
from checker.models import BASE, KNOWN, PAIRS, TERMS, UNIT, Model, symbols

SEEDS = st.integers(0, 2**32)
#: Without products of symbols, and with them.
SYMBOLS = st.sampled_from([2, KNOWN + 2])
FUNCTIONS = {
    "tanh": (models.tanh, lambda y: y.tanh(), 2.0),
    "sigmoid": (models.sigmoid, lambda y: 1 / (1 + (-y).exp()), 3.0),
    "relu": (models.relu, lambda y: y.max(arb(0)), 0.5),
    "sine": (models.sine, lambda y: y.sin(), 4.0),
    "cosine": (models.cosine, lambda y: y.cos(), 4.0),
    "tan": (models.tan, lambda y: y.tan(), 0.3),
    "sinc": (models.sinc, lambda y: y.sinc(), 0.2),
    "cosine_of_slope": (models.cosine_of_slope, lambda y: 1 / (1 + y * y).sqrt(), 0.3),
    "reciprocal": (lambda z: models.reciprocal(models.plus(z, arb(3))), lambda y: 1 / (y + 3), 1.0),
}


def some(random: np.random.Generator, centre: float, size: float, count: int = 2) -> Model:
    """Return a model with coefficients of up to ``size``, falling with their order."""
    p = [size * random.uniform(-1, 1) * 0.5**k for k in range(TERMS)]
    p[0] = random.uniform(-centre, centre)
    e = size * random.uniform(-0.3, 0.3, 2 * count) * min(1.0, 4 / count)
    return [*map(arb, p), *map(arb, e.tolist()), arb(0.1 * size * random.uniform()) * UNIT]


def member(z: Model, x: float, e: np.ndarray, rest: float) -> arb:
    """Return the value of a model at a place, with a share of its rest (of at most 1)."""
    total = sum((c * arb(x) ** k for k, c in enumerate(z[:TERMS])), z[-1].rad() * rest)
    count = symbols(z)
    for j in range(count):
        total += (z[TERMS + j] + z[TERMS + count + j] * arb(x)) * arb(float(e[j]))
    return total


def places(random: np.random.Generator, count: int = 2):
    """Yield places x, e, rest; products of symbols are what they have to be, exactly."""
    for k in range(12):
        x = float([-1, 1, 0][k]) if k < 3 else random.uniform(-1, 1)
        e = random.choice([-1.0, 1.0, 0.25], count)
        if count >= KNOWN:
            e[BASE:KNOWN] = [e[i] * e[j] if i != j else 2 * e[i] ** 2 - 1 for i, j in PAIRS]
        yield x, e, random.choice([-1.0, 1.0])


def filled(z: Model, value: arb, x: float, e: np.ndarray) -> float:
    """Return how much of the rest of z a value needs; NaN, or more than 1, if it is outside."""
    stray = abs(value - member(z, x, e, 0.0)).upper()
    return float((stray / (z[-1].rad() + arb("1e-27"))).upper())


@pytest.mark.parametrize("name", FUNCTIONS)
@given(SEEDS, st.sampled_from([0.3, 0.1, 1e-3, 1e-9]), SYMBOLS)
def test_functions_contain_their_values(name, seed, size, count):
    random = np.random.default_rng(seed)
    function, exact, centre = FUNCTIONS[name]
    z = some(random, centre, size, count)
    y = function(z)
    for x, e, rest in places(random, count):
        assert filled(y, exact(member(z, x, e, rest)), x, e) <= 1


@pytest.mark.parametrize("name", sorted(FUNCTIONS.keys() - {"sinc", "cosine_of_slope"}))
def test_functions_are_tight(name):
    """Some member needs most of the rest: it is no loose bound.

    The other two have constant bounds of their second derivatives: their arguments are small.
    """
    random = np.random.default_rng(1)
    function, exact, centre = FUNCTIONS[name]
    most = 0.0
    for _ in range(60):
        z = some(random, centre, 0.1)
        y = function(z)
        for x, e, rest in places(random):
            most = max(most, filled(y, exact(member(z, x, e, rest)), x, e))
    assert 0.5 < most <= 1


@given(SEEDS, st.sampled_from([1.0, 1e-3]), SYMBOLS)
def test_sums_products_and_multiples_contain_their_values(seed, size, count):
    random = np.random.default_rng(seed)
    z, w = some(random, 2.0, size, count), some(random, 2.0, size, count)
    factor = arb(random.uniform(-2, 2))
    near = models.add(z, models.scale(w, arb(1) / 100))
    results = [
        (models.add(z, w), lambda p, q: p + q),
        (models.subtract(z, w), lambda p, q: p - q),
        (models.multiply(z, w), lambda p, q: p * q),
        (models.scale(z, factor), lambda p, q: p * factor),
        (models.plus(z, factor), lambda p, q: p + factor),
        (models.maximum(z, w), lambda p, q: p.max(q)),
        (models.minimum(z, w), lambda p, q: p.min(q)),
        (models.maximum(z, near), lambda p, q: p.max(p + q / 100)),
        (models.minimum(z, near), lambda p, q: p.min(p + q / 100)),
    ]
    for x, e, rest in places(random, count):
        p, q = member(z, x, e, rest), member(w, x, e, -rest)
        for y, exact in results:
            assert filled(y, exact(p, q), x, e) <= 1


@given(SEEDS, st.sampled_from([1.0, 0.1, 1e-3]))
def test_readings_contain_their_values(seed, size):
    """Of members below the least value 1 / u is that of the least value: a clipped reading."""
    random = np.random.default_rng(seed)
    z, least = some(random, 1.0, size), arb("0.2")
    z = models.plus(z, arb(random.uniform(0.0, 2.0)))
    y = models.inverse_from(z, least)
    # The line holds for values of z from the least on; the rest of z is not asked about.
    for x, e, rest in places(random):
        u = member(z, x, e, rest)
        if u >= least:
            assert filled(y, 1 / u, x, e) <= 1


def test_a_line_is_the_tighter_reading_near_the_range():
    """u = 0.2 +- 0.05 at a range of 5 m is a reading of 4 to 5 m: a line errs by 0.06 m there."""
    z = [arb(0)] * (TERMS + 2 * 2 + 1)
    z[0], z[TERMS] = arb("0.2"), arb("0.05")
    y = models.inverse_from(z, arb("0.2"))
    a, b = 0.2, 0.25
    k = 1 / (a * b)
    assert float(y[-1].rad()) == pytest.approx((a * k + 1 / a - 2 * k**0.5) / 2, rel=1e-6)


def test_the_larger_and_the_smaller_of_two_models_are_tight():
    """x and 0: x is in [-1, 1], so both are x / 2 + 1/4 +- 1/4, and exact where it is clear."""
    x, zero = [arb(0), arb(1), *[arb(0)] * 5], [arb(0)] * 7
    for function, sign in ((models.maximum, 1), (models.minimum, -1)):
        y = function(x, zero)
        assert (float(y[0]), float(y[1])) == pytest.approx((sign * 0.25, 0.5), rel=1e-8)
        assert abs(float(y[-1].rad()) - 0.25) < 1e-8
        above = models.plus(x, arb(1.5))
        assert function(above, zero) == (above if sign > 0 else zero)


@given(SEEDS)
def test_bounds_contain_and_nearly_touch_the_values(seed):
    random = np.random.default_rng(seed)
    z = some(random, 1.0, 0.1)
    b = models.bound(z)
    seen = [member(z, *place) for place in places(random)]
    assert all(b.contains(v) for v in seen)
    assert float(b.rad()) < 2 * 0.1 * (2 + 2 * 2 * 0.3 + 0.1)


@given(SEEDS, SYMBOLS, st.integers(0, KNOWN + 2))
def test_a_part_has_the_values_of_the_whole_there(seed, count, parameter):
    random = np.random.default_rng(seed)
    z = some(random, 1.0, 0.3, count)
    parameter %= count + 1
    low, high = sorted(random.uniform(-1, 1, 2).tolist())
    if count >= KNOWN and BASE < parameter <= KNOWN:
        with pytest.raises(ValueError, match="product"):
            models.restrict(z, parameter, arb(low), arb(high))
        return
    part = models.restrict(z, parameter, arb(low), arb(high))
    for x, e, rest in places(random, count):
        there, f = [x, *e], arb(low) + (arb(high) - arb(low)) * (arb([x, *e][parameter]) + 1) / 2
        there[parameter] = float(f.mid())
        if count >= KNOWN:
            known = there[1:]
            products = [known[i] * known[j] if i != j else 2 * known[i] ** 2 - 1 for i, j in PAIRS]
            there[1 + BASE : 1 + KNOWN] = products
        value = member(z, there[0], np.array(there[1:]), rest)
        assert abs(value - member(part, x, e, rest)) < 1e-14


@given(SEEDS, st.floats(-0.2, 0.2))
def test_positive_is_only_said_of_what_is(seed, shift):
    random = np.random.default_rng(seed)
    z = some(random, 0.0, 0.2)
    z[0] = arb(shift)
    if models.positive(z):
        assert all(member(z, *place) > 0 for place in places(random))
    else:
        assert not models.bound(z) > 0


def test_positive_finds_a_bound_beside_a_root():
    """x - 0.5 on [0.501, 1], and a parabola that stays just above 0."""
    line = [arb(-0.5), arb(1), *[arb(0)] * 4, arb(0.0009) * UNIT]
    assert models.positive(models.restrict(line, 0, arb(0.501), arb(1)))
    assert not models.positive(models.restrict(line, 0, arb(0.4), arb(1)))
    parabola = [arb(0.0901), arb(-0.6), arb(1), *[arb(0)] * 3, arb(0.00005) * UNIT]
    assert models.positive(parabola)
    assert not models.positive(models.plus(parabola, arb(-0.0001)))

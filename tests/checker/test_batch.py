"""Models and the network in doubles: against exact members, and against Arb."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from flint import arb
from hypothesis import given
from hypothesis import strategies as st
from test_arithmetic import filled, member, places, some

from checker import balls, batch, batch_network, models
from checker.balls import Balls
from checker.batch_network import BatchNetwork
from checker.files import Layer
from checker.models import KNOWN, ONE, symbols
from checker.step import Network

SEEDS = st.integers(0, 2**32)
SIZES = st.sampled_from([1.0, 0.1, 1e-3, 1e-9, 0.0])
SYMBOLS = st.sampled_from([2, KNOWN + 2])
VALUES = {
    "Tanh": lambda y: y.tanh(),
    "Sigmoid": lambda y: 1 / (1 + (-y).exp()),
    "Relu": lambda y: y.max(arb(0)),
    "": lambda y: y,
}


def layers(random: np.random.Generator, kind: str, widths: list[int]) -> list[Layer]:
    """Return random layers, the last one of tanh."""
    out = []
    for inside, outside in itertools.pairwise(widths):
        weights = random.normal(size=(outside, inside)) / inside**0.5 * random.uniform(0.5, 3)
        biases = random.normal(size=outside) * 0.5
        out.append(Layer(weights.astype(np.float32), biases.astype(np.float32), kind))
    return out


def answer(network: list[Layer], scan: list[arb]) -> arb:
    """Return the exact output for numbers."""
    values = scan
    for layer in network:
        rows, biases = layer.weights.tolist(), layer.biases.tolist()
        sums = [
            sum((arb(w) * v for w, v in zip(row, values, strict=True)), arb(b))
            for row, b in zip(rows, biases, strict=True)
        ]
        values = [VALUES[layer.activation](y) for y in sums]
    return values[0]


FUNCTIONS = {
    "sine": (batch.sine, models.sine, lambda y: y.sin(), 0.0),
    "cosine": (batch.cosine, models.cosine, lambda y: y.cos(), 0.0),
    "reciprocal": (batch.reciprocal, models.reciprocal, lambda y: 1 / y, 3.0),
    "inverse": (batch.inverse, lambda z: models.inverse_from(z, arb(0)), lambda y: 1 / y, 3.0),
    "wide inverse": (batch.inverse, lambda z: models.inverse_from(z, arb(0)), lambda y: 1 / y, 1.9),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@given(SEEDS, st.sampled_from([0.3, 0.1, 1e-3, 1e-9, 0.0]), SYMBOLS)
def test_functions_contain_their_values_and_are_hardly_wider_than_arb_s(name, seed, size, count):
    random = np.random.default_rng(seed)
    function, slow, exact, shift = FUNCTIONS[name]
    z = some(random, 1.0, size, count)
    z[0] += shift
    found = balls.to_arb(function(batch.of_models([z])).at(0))
    for x, e, rest in places(random, count):
        assert filled(found, exact(member(z, x, e, rest)), x, e) <= 1
    assert float(found[-1].rad()) <= 1.01 * float(slow(z)[-1].rad()) + 1e-12


@given(SEEDS, SIZES, SYMBOLS)
def test_products_contain_their_values_and_are_hardly_wider_than_arb_s(seed, size, count):
    random = np.random.default_rng(seed)
    z, w = (some(random, 2.0, size, count) for _ in range(2))
    both = batch.of_models([z]), batch.of_models([w])
    found = balls.to_arb(batch.product(*both).at(0))
    for x, e, rest in places(random, count):
        for other in (rest, -rest):
            exact = member(z, x, e, rest) * member(w, x, e, other)
            assert filled(found, exact, x, e) <= 1
    assert float(found[-1].rad()) <= 1.01 * float(models.multiply(z, w)[-1].rad()) + 1e-12


def test_where_zero_is_not_excluded_there_is_no_reciprocal():
    z = batch.of_models([some(np.random.default_rng(0), 0.1, 1.0)])
    with np.errstate(all="ignore"):
        found = [batch.reciprocal(z), batch.inverse(z)]
    assert not any(np.isfinite(x.middle + x.radius).all() for x in found)


@pytest.mark.parametrize("kind", VALUES)
@given(SEEDS, SIZES, SYMBOLS)
def test_answers_contain_those_of_all_members(kind, seed, size, count):
    random = np.random.default_rng(seed)
    network = [*layers(random, kind, [4, 6, 5]), *layers(random, "Tanh", [5, 1])]
    scan = [some(random, 2.0, size, count) for _ in range(4)]
    (found,) = BatchNetwork(network).steering([batch.of_models(scan)])
    assert found is not None
    for x, e, rest in places(random, count):
        exact = answer(network, [member(z, x, e, rest) for z in scan])
        assert filled(found, exact, x, e) <= 1


@pytest.mark.parametrize("kind", ["Tanh", "Relu", "Sigmoid"])
@given(SEEDS, SIZES, SYMBOLS)
def test_answers_are_hardly_wider_than_those_of_arb(kind, seed, size, count):
    random = np.random.default_rng(seed)
    network = [*layers(random, kind, [4, 6, 5]), *layers(random, "Tanh", [5, 1])]
    scan = [some(random, 2.0, size, count) for _ in range(4)]
    try:
        slow = Network(network).steering(scan)
    except ArithmeticError:
        return
    (found,) = BatchNetwork(network).steering([batch.of_models(scan)])
    assert found is not None
    assert symbols(found) == symbols(slow)
    assert float(found[-1].rad()) <= 1.05 * float(slow[-1].rad()) + 1e-12


@given(SEEDS, st.integers(1, 70))
def test_each_scan_gets_its_own_answer(seed, count):
    random = np.random.default_rng(seed)
    network = layers(random, "Tanh", [3, 4, 1])
    scans = [[some(random, 2.0, 0.01) for _ in range(3)] for _ in range(count)]
    together = BatchNetwork(network).steering(list(map(batch.of_models, scans)))
    for k in {0, count // 2, count - 1}:
        (alone,) = BatchNetwork(network).steering([batch.of_models(scans[k])])
        assert alone is not None
        pairs = zip(alone, together[k], strict=True)
        assert all(abs(float((x - y).mid())) <= 1e-12 for x, y in pairs)


def test_what_overflows_has_no_answer():
    huge = Layer(np.full((1, 1), 3e38, np.float32), np.zeros(1, np.float32), "")
    scan = [some(np.random.default_rng(0), 2.0, 1.0)]
    scan[0][1] = ONE * 1e300
    assert BatchNetwork([huge, huge]).steering([batch.of_models(scan)]) == [None]


@given(SEEDS, st.integers(1, 30), SYMBOLS)
def test_the_rest_of_a_layer_s_sums_holds_their_rounding(seed, inputs, count):
    """All entries of a sum may be off at once: x and the symbols are at most 1."""
    random = np.random.default_rng(seed)
    weights = 10.0 ** random.uniform(-6, 3, (2, inputs)) * random.choice([-1, 1], (2, inputs))
    biases = random.normal(size=2) * 10.0 ** random.uniform(-6, 3, 2)
    entries = models.TERMS + 2 * count + 1
    middle = random.normal(size=(2, inputs, entries)) * 10.0 ** random.uniform(-9, 2, entries)
    z = batch.settled(Balls(middle, np.zeros_like(middle)))
    z.radius[..., -1] *= random.choice([0, 1])
    found = batch_network._affine(weights, biases, batch.by_entry(z))
    exact = np.vectorize(Fraction, otypes=[object])
    for k, row in np.ndindex(2, 2):
        sums = exact(weights[row]) @ exact(z.middle[k])
        sums[0] += Fraction(biases[row])
        off = sum(abs(x - y) for x, y in zip(sums, exact(found.middle[k, row]), strict=True))
        least = off + exact(np.abs(weights[row])) @ exact(z.radius[k, :, -1])
        rest = Fraction(found.radius[k, row, -1])
        assert least <= rest <= least * (1 + Fraction(1, 2**30)) + Fraction(1, 10**6)
        assert not found.radius[k, row, :-1].any()

"""Bounds of chains of layers: against exact values in Arb at points of random boxes."""

import itertools

import numpy as np
import pytest
from asking import ACTIVATIONS, computed, some_layers
from flint import arb, arb_mat
from hypothesis import given
from hypothesis import strategies as st

from checker.files import Layer
from checker.query.chain import Chain

VALUES = {
    "Tanh": lambda y: y.tanh(),
    "Sigmoid": lambda y: (1 + (y / 2).tanh()) / 2,
    "Relu": lambda y: y.max(arb(0)),
    "": lambda y: y,
}


def exactly(layers, point):
    """Return the outputs in Arb at a point of doubles."""
    z = arb_mat([[float(x)] for x in point])
    for weights, biases, kind in layers:
        z = arb_mat(weights.tolist()) * z + arb_mat([[float(b)] for b in biases])
        z = arb_mat([[VALUES[kind](y)] for y in z.entries()])
    return z.entries()


@given(
    seed=st.integers(0, 2**32),
    hidden=st.lists(st.tuples(st.integers(1, 6), st.sampled_from(ACTIVATIONS)), max_size=3),
    size=st.sampled_from([0.0, 1e-9, 0.01, 1.0, 100.0]),
)
def test_no_value_lies_below_a_bound(seed, hidden, size):
    random = np.random.default_rng(seed)
    widths = [3, *(width for width, _ in hidden), 2]
    layers = some_layers(random, widths, [*(kind for _, kind in hidden), ""])
    chain = Chain([Layer(*layer) for layer in layers])
    middle, half = random.normal(size=3), size * random.uniform(size=3)
    lower, upper = middle - half, middle + half
    factors = np.array([[1.0, 0.0], [-1.0, 0.0], [0.5, -2.0]])
    least = chain.least(lower[None], upper[None], factors)[0]
    corners = [np.where(signs, lower, upper) for signs in itertools.product([0, 1], repeat=3)]
    points = [*corners, *(random.uniform(lower, upper) for _ in range(8))]
    for point in points:
        outputs = exactly(layers, np.clip(point, lower, upper))
        for row, bound in zip(factors, least, strict=True):
            assert sum(arb(f) * y for f, y in zip(row.tolist(), outputs, strict=True)) >= bound


@given(seed=st.integers(0, 2**32), kinds=st.tuples(*[st.sampled_from(ACTIVATIONS)] * 2))
def test_at_a_point_the_bound_is_the_value(seed, kinds):
    random = np.random.default_rng(seed)
    layers = some_layers(random, [4, 7, 5, 1], [*kinds, ""])
    point = random.normal(size=(1, 4))
    chain = Chain([Layer(*layer) for layer in layers])
    ends = chain.least(point, point, np.array([[1.0], [-1.0]]))[0]
    value = computed(layers, point)[0, 0]
    assert ends[0] <= value + 1e-12
    assert -ends[1] >= value - 1e-12
    assert ends[0] == pytest.approx(value, abs=1e-9)
    assert -ends[1] == pytest.approx(value, abs=1e-9)


def test_many_boxes_give_what_each_gives_alone(monkeypatch):
    random = np.random.default_rng(5)
    layers = some_layers(random, [3, 8, 1], ["Tanh", ""])
    chain = Chain([Layer(*layer) for layer in layers])
    lower = random.normal(size=(9, 3))
    upper = lower + random.uniform(size=(9, 3))
    factors = np.array([[1.0]])
    together = chain.least(lower, upper, factors)
    monkeypatch.setattr("checker.query.chain._ROOM", 1)
    assert chain.least(lower, upper, factors) == pytest.approx(together, abs=1e-12)


def test_an_overflow_proves_nothing():
    large = np.full((1, 1), 3e38, np.float32)
    layer = Layer(large, np.zeros(1, np.float32), "Relu")
    chain = Chain([layer] * 9)
    least = chain.least(np.array([[1e38]]), np.array([[2e38]]), np.array([[1.0]]))
    assert not least[0, 0] > 0

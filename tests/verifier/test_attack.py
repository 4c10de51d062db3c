"""What the search for the worst attack is made of: gradients, choices, starts, states."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from whole_runs import random_controller

from racecar.closed_loop import State
from racecar.controller import Controller, Layer
from verifier.attack import steering_gradient, strongest_missing
from verifier.evolution import Evolution
from verifier.starts import spread
from verifier.tree import different


@given(seed=st.integers(0, 2**32 - 1), activation=st.sampled_from(["tanh", "sigmoid", "relu"]))
def test_the_gradient_is_that_of_the_steering(seed, activation):
    random = np.random.default_rng(seed)
    controller = random_controller(random, 5, activation)
    scan = random.uniform(0, 5, (5, 3))
    found = steering_gradient(controller, scan)
    step = 1e-5
    for ray in range(5):
        change = np.zeros((5, 1))
        change[ray] = step
        high = controller.steering_rows(scan + change)
        low, middle = controller.steering_rows(scan - change), controller.steering_rows(scan)
        smooth = np.abs(high - 2 * middle + low) < 1e-9  # no kink of a relu in between
        slope = (high - low) / (2 * step)
        assert np.allclose(found[ray][smooth], slope[smooth], atol=2e-4)


@given(seed=st.integers(0, 2**32 - 1), side=st.sampled_from([-1.0, 1.0]), most=st.integers(1, 3))
def test_the_strongest_missing_rays_are_found_one_after_the_other(seed, side, most):
    random = np.random.default_rng(seed)
    controller = random_controller(random, 6, "tanh")
    scan = random.uniform(0, 5, (6, 4))
    found = strongest_missing(controller, scan, np.full(4, side), most, 5.0)
    for car in range(4):
        chosen, current = set(), scan[:, car].copy()
        for _ in range(most):
            gains = []
            for ray in range(6):
                tried = current.copy()
                tried[ray] = 5.0
                both = np.stack([current, tried], axis=1)
                before, after = controller.steering_rows(both)
                gains.append(side * (after - before))
            best = int(np.argmax(gains))
            if gains[best] < 1e-5:  # float32 decides
                break
            chosen.add(best)
            current[best] = 5.0
        own = set(np.flatnonzero(found[:, car]).tolist())
        assert (
            chosen <= own
            or gain_of(controller, scan[:, car], own, side)
            >= gain_of(controller, scan[:, car], chosen, side) - 1e-4
        )


def gain_of(controller: Controller, scan: np.ndarray, gone: set[int], side: float) -> float:
    """Return how far missing rays move the steering to a side."""
    tried = scan.copy()
    tried[list(gone)] = 5.0
    before, after = controller.steering_rows(np.stack([scan, tried], axis=1))
    return float(side * (after - before))


def test_with_many_rays_the_strongest_is_among_those_tried():
    random = np.random.default_rng(0)
    weights = random.uniform(0, 0.01, (1, 300)).astype(np.float32)
    weights[0, 123] = 0.5
    controller = Controller((Layer(weights, np.zeros(1, np.float32), "tanh"),))
    found = strongest_missing(controller, np.full((300, 2), 1.0), np.ones(2), 1, 5.0)
    assert np.flatnonzero(found[:, 0]).tolist() == [123]


@given(
    seed=st.integers(0, 2**32 - 1), count=st.integers(1, 400), most=st.integers(16, 200),
    flat=st.booleans(),
)  # fmt: skip
def test_kept_states_are_different_and_the_extremes_are_among_them(seed, count, most, flat):
    random = np.random.default_rng(seed)
    x = random.normal(size=(4, count))
    x[2] = 1.0
    if flat:
        x[3] = 2 * x[0]
    state = State.start(x[0], x[1], x[2], x[3])
    kept = different(state, most, random)
    assert len(kept) == len(set(kept.tolist())) <= max(most, 8)
    if count > most >= 100:
        # Something of the outermost tenth is kept on each side of each axis.
        for axis in (0, 1):
            order = np.argsort(x[axis])
            tenth = max(1, count // 10)
            assert set(kept) & set(order[:tenth])
            assert set(kept) & set(order[-tenth:])
    if count <= most:
        assert kept.tolist() == list(range(count))


@given(
    lower=st.lists(st.floats(-1, 1), min_size=4, max_size=4),
    width=st.lists(st.sampled_from([0.0, 1e-300, 1e-9, 0.3]), min_size=4, max_size=4),
    count=st.integers(1, 70),
    seed=st.integers(0, 99),
)
def test_starts_are_spread_within_the_box_exactly(lower, width, count, seed):
    low = np.array(lower)
    high = low + np.array(width)
    starts = spread(low, high, count, np.random.default_rng(seed))
    assert len(starts) == count
    assert np.all((starts >= low) & (starts <= high))


def test_evolution_finds_the_least_of_a_narrow_valley():
    """Rosenbrock's function of three numbers, its least at 0.6 in each."""
    random = np.random.default_rng(0)

    def value(x: np.ndarray) -> np.ndarray:
        y = 1 + 2 * (x - 0.6)
        return np.sum(100 * (y[:, 1:] - y[:, :-1] ** 2) ** 2 + (1 - y[:, :-1]) ** 2, axis=1)

    evolution = Evolution(np.array([0.1, 0.9, 0.2]), 0.2, 16, random)
    for _ in range(300):
        points = evolution.ask()
        assert np.all((points >= 0) & (points <= 1))
        evolution.tell(points, value(points))
    assert np.abs(evolution.ask() - 0.6).max() < 1e-3

"""Disturbed scans on models: every reading that the set allows leads to steering inside."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from enclosed import rows_of, value_at
from exact_members import random_models
from hypothesis import given, settings
from hypothesis import strategies as st
from members import inside
from whole_runs import random_controller

from racecar.closed_loop import State
from racecar.disturbance import Disturbance
from racecar.faults import in_turn
from verifier import disturbed as under_test
from verifier.disturbed import cases, hull, region, steering_apart, steering_of_choices, without
from verifier.models import TERMS, Models, bounds, stack
from verifier.network import Network
from verifier.rows import F, Inside, S

SEEDS = st.integers(0, 2**32 - 1)
RAYS, ROWS, SYMBOLS, REACH, WIDTH = 5, 3, 2, 5.0, 1.5


def scan_of(random: np.random.Generator, error: float) -> Models:
    scan = random_models(random, (RAYS, ROWS), 0.02, SYMBOLS, error, 0.0)
    scan.c[0] = random.uniform(0.5, 3.0, (RAYS, ROWS))
    return scan


def place(random: np.random.Generator) -> tuple[float, np.ndarray]:
    return float(random.uniform(-1, 1)), random.choice([-1.0, 1.0, 0.4], SYMBOLS)


def off(steering: Models, row: int, x: float, e: np.ndarray, value: float) -> float:
    """Return how far a value is from a model at x and e of the state, over what is left free."""
    own = Models(steering.c[: TERMS + 2 * SYMBOLS], steering.radius)
    free = np.abs(steering.c[TERMS + 2 * SYMBOLS :, row]).sum() + steering.radius[row]
    return float(abs(value - value_at(own, row, x, e)) / (free + 1e-13))


def worst_of_noise(
    seed: int, noise: float, error: float, activation: str, width: float = 1.0
) -> float:
    random = np.random.default_rng(seed)
    controller = random_controller(random, RAYS, activation)
    scan = scan_of(random, error)
    scan.c[1:TERMS] *= width
    steering = steering_apart(Network(controller), scan, noise)
    assert steering.symbols == SYMBOLS + 1
    found = []
    for row in range(ROWS):
        for _ in range(20):
            x, e = place(random)
            rest = random.choice([-1.0, 1.0], RAYS) * scan.radius[:, row]
            readings = value_at(scan, row, x, e) + rest
            slopes = [
                controller.steering_rows((readings + 1e-6 * unit)[:, None])[0]
                for unit in np.eye(RAYS)
            ]
            push = np.sign(slopes - controller.steering_rows(readings[:, None])[0])
            for n in (push, -push, random.uniform(-1, 1, RAYS), random.choice([-1, 1], RAYS)):
                clipped = np.clip(readings + noise * n, 0, REACH)
                value = float(controller.steering_rows(clipped[:, None])[0])
                found.append(off(steering, row, x, e, value))
    return max(found)


@settings(max_examples=15)
@given(
    SEEDS, st.sampled_from([0.0, 1e-3, 0.05]), st.sampled_from([0.0, 1e-6, 1e-2]),
    st.sampled_from(["tanh", "relu"]),
)  # fmt: skip
def test_all_noise_is_in_the_steering(seed, noise, error, activation):
    assert worst_of_noise(seed, noise, error, activation) <= 1


def test_small_noise_fills_the_steering_and_a_tenth_less_shows(monkeypatch):
    assert 0.9 < max(worst_of_noise(seed, 1e-4, 0.0, "tanh", 0.01) for seed in range(3)) <= 1
    monkeypatch.setattr(under_test, "UP", 0.95)
    assert max(worst_of_noise(seed, 1e-4, 0.0, "tanh", 0.01) for seed in range(3)) > 1


@settings(max_examples=30)
@given(SEEDS, st.integers(1, 4))
def test_the_hull_holds_every_member_of_each(seed, count):
    random = np.random.default_rng(seed)
    many = [random_models(random, (ROWS,), 0.1, SYMBOLS, 0.05, 0.2) for _ in range(count)]
    whole = hull(many)
    assert whole.symbols == SYMBOLS + 1
    for models in many:
        for row in range(ROWS):
            for _ in range(10):
                x, e = place(random)
                rest = random.choice([-1.0, 1.0]) * models.radius[row]
                value = float(value_at(models, row, x, e)) + rest
                assert off(whole, row, x, e, value) <= 1


def test_the_hull_is_no_larger_than_what_it_holds():
    """1, 2 and 4, exactly: 2.5 +- 1.5."""
    c = np.zeros((TERMS, 3))
    c[0] = [1.0, 2.0, 4.0]
    whole = hull([Models(c[:, [i]], np.zeros(1)) for i in range(3)])
    low, high = bounds(whole)
    assert (low[0], high[0]) == (pytest.approx(1, abs=1e-10), pytest.approx(4, abs=1e-10))
    assert low[0] <= 1
    assert high[0] >= 4


def test_hulls_of_unknown_steering_are_unknown():
    known = Models(np.zeros((TERMS, 1)), np.zeros(1))
    for bad in (np.nan, np.inf):
        with np.errstate(invalid="ignore"):
            whole = hull([known, Models(np.zeros((TERMS, 1)), np.full(1, bad))])
            low, high = bounds(whole)
        assert not (low[0] > -1e300 and high[0] < 1e300)


def test_missing_rays_read_the_range():
    scan = scan_of(np.random.default_rng(0), 0.1)
    scan.c[0, 0, 0] = np.nan
    gone = np.zeros((RAYS, ROWS), dtype=bool)
    gone[0, 0] = gone[3, 2] = True
    after = without(scan, gone, REACH)
    assert after.c[0][gone].tolist() == [REACH, REACH]
    assert not after.c[1:, gone].any()
    assert not after.radius[gone].any()
    assert (after.c[:, ~gone] == scan.c[:, ~gone]).all()
    assert (after.radius[~gone] == scan.radius[~gone]).all()


@settings(max_examples=10)
@given(SEEDS, st.sampled_from([1, 2]), st.sampled_from([0.0, 0.01]))
def test_every_choice_of_rays_is_in_the_steering(seed, most, noise):
    random = np.random.default_rng(seed)
    controller = random_controller(random, RAYS, "tanh", 0.3)
    scan = scan_of(random, 1e-3)
    inside_turn = np.array([True, False, True])
    steering = steering_of_choices(Network(controller), scan, inside_turn, most, noise, REACH)
    for row in range(ROWS):
        for k in range(most + 1):
            for some in combinations(range(RAYS), k):
                x, e = place(random)
                readings = value_at(scan, row, x, e)
                readings = readings + random.choice([-1, 1], RAYS) * scan.radius[:, row]
                readings = readings + noise * random.choice([-1, 1], RAYS)
                if inside_turn[row]:
                    readings[list(some)] = REACH
                value = float(controller.steering_rows(readings[:, None])[0])
                # The noise's symbol and the hull's are free.
                assert off(steering, row, x, e, value) <= 1


def test_the_cases_are_all_sets_of_so_many_rays():
    def of(missing: int, choice: str, rays: int = 4) -> list[tuple[bool, ...]]:
        given = Disturbance(noise=0.0, missing=missing, turn_only=True, choice=choice)
        return [tuple(mask) for mask in cases(given, rays).tolist()]

    assert cases(None, 4).tolist() == [[False] * 4]
    wanted = {
        tuple(i in some for i in range(4)) for k in range(3) for some in combinations(range(4), k)
    }
    assert set(of(2, "run")) == wanted
    assert len(of(2, "run")) == len(wanted) == 11
    assert of(2, "step") == [(True,) * 4]
    with pytest.raises(under_test.TooManyChoices):
        of(3, "run", 41)
    with pytest.raises(under_test.TooManyChoices):
        of(3, "step", 41)


@settings(max_examples=60)
@given(SEEDS)
def test_where_rays_are_missing(seed):
    """Rows near the turn's borders: inside, outside, or asked for by a guard or a split."""
    random = np.random.default_rng(seed)
    state = random_models(random, (4, 6), 10 ** random.uniform(-3, 0), SYMBOLS, 0.01, 0.0)
    state.c[0, S] = random.choice([0.0, 0.02, 0.7, 1.48, 1.5, 1.6], 6)
    state.c[0, F] = random.choice([1.0, 2.48, 2.5, 2.6, 9.0], 6)
    rows = rows_of(state)
    missing = random.random(6) < 0.8
    found = region(rows, missing, True, WIDTH)
    guarded = set() if found.guards is None else set(found.guards.row.tolist())
    for row in range(6):
        if found.unclear[row]:
            assert missing[row]
            assert row not in guarded
            continue
        for _ in range(30):
            x, e = place(random)
            rest = random.choice([-1, 1], 4) * state.radius[:, row]
            car = value_at(state, row, x, e) + rest
            there = bool(in_turn(State.start(*car[:, None]), WIDTH)[0]) and bool(missing[row])
            if row not in guarded:
                assert bool(found.inside[row]) == there
                continue
            # The guard's sign decides.
            n = found.guards.row.tolist().index(row)
            models = found.guards.models
            values = np.concatenate([x ** np.arange(TERMS), np.ravel(np.stack([e, e * x], axis=1))])
            value, radius = values @ models.c[:, n], models.radius[n] + 1e-12
            assert value + radius >= 0 if there else value - radius <= 0
            assert found.guards.decisions[n] == Inside(True)
    for positive in (True, False):
        told = replace(rows, decisions=((Inside(positive),),) * 6)
        again = region(told, missing, True, WIDTH)
        assert (again.inside == (missing & positive)).all()
        assert not again.unclear.any()
        assert again.guards is None or not len(again.guards.row)


def test_rays_that_are_missing_anywhere():
    rows = rows_of(random_models(np.random.default_rng(0), (4, 3), 0.1, SYMBOLS))
    missing = np.array([True, False, True])
    found = region(rows, missing, False, WIDTH)
    assert found.inside.tolist() == missing.tolist()
    assert found.guards is None
    assert not found.unclear.any()


def test_members_are_found_and_others_are_not():
    """The tests of whole runs rest on this."""
    random = np.random.default_rng(3)
    state = random_models(random, (4,), 0.1, 5, 0.02, 1.0)
    # As states are: nearly straight.
    state.c[2:TERMS] *= 0.05
    state.c[TERMS + 1 :: 2] *= 0.1
    state = Models(state.c, np.full(4, 1e-6))
    x = random.uniform(-1, 1, 20)
    e = random.choice([-1.0, 1.0], (20, 5))
    values = np.stack(
        [value_at(Models(state.c[..., None], state.radius[:, None]), 0, a, b)
         for a, b in zip(x, e, strict=True)], axis=1,
    )  # fmt: skip
    assert inside(state, values, x, 1e-12)[0].all()
    assert inside(state, values, None, 1e-12)[0].mean() > 0.9
    beyond = values + 1.01 * np.abs(state.c[1:]).sum(axis=0)[:, None] * np.sign(
        values - state.c[0][:, None]
    )
    assert not inside(state, beyond, None, 1e-12)[0].any()
    assert stack([Models(state.c[:, i], state.radius[i]) for i in range(4)]).c.shape == (16, 4)

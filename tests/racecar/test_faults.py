"""Faults: what is drawn, where it is active, and that a seed gives it again."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from racecar.closed_loop import State
from racecar.errors import BadInput
from racecar.faults import FAULTS, DrawnFaults, Faults, GivenFaults, in_turn

RAYS, RUNS = 21, 4000
IN_TURN, IN_HALL = (0.75, 1.0), (0.75, 9.0)


def draw(faults: Faults, seed: int = 0, rays: int = RAYS, runs: int = RUNS) -> DrawnFaults:
    return faults.draw(rays, runs, 1.5, 5.0, np.random.default_rng(seed))


def cars(place: tuple[float, float], runs: int = RUNS) -> State:
    s, f = place
    return State.start(np.full(runs, s), f)


def test_rays_are_drawn_with_replacement():
    """The number of different rays among 5 of 21 has a known distribution."""
    gone = draw(Faults(missing=5)).gone.sum(axis=0)
    assert gone.max() == 5
    assert gone.min() >= 1
    # All different: 20 * 19 * 18 * 17 / 21^4.
    expected = 20 * 19 * 18 * 17 / 21**4
    error = math.sqrt(expected * (1 - expected) / RUNS)
    assert abs(np.mean(gone == 5) - expected) < 4 * error
    # Expected number: 21 (1 - (20/21)^5).
    assert gone.mean() == pytest.approx(21 * (1 - (20 / 21) ** 5), abs=0.05)


def test_every_ray_is_drawn_as_often_as_any_other():
    share = draw(Faults(missing=1)).gone.mean(axis=1)
    error = math.sqrt(20 / 21**2 / RUNS)
    assert np.abs(share - 1 / 21).max() < 5 * error


def test_missing_rays_read_the_range_and_stay_missing():
    drawn = draw(Faults(missing=5))
    scan = np.full((RAYS, RUNS), 1.0)
    for step in (0, 1, 69):
        faulty = drawn(step, cars(IN_TURN), scan)
        assert (faulty[drawn.gone] == 5.0).all()
        assert (faulty[~drawn.gone] == 1.0).all()
    assert (scan == 1.0).all()


@pytest.mark.parametrize(
    ("s", "f", "active"),
    [
        (0.75, 2.5, True),
        (0.75, 2.5000001, False),
        (0.0, 1.0, False),
        (1e-9, 1.0, True),
        (1.5, 1.0, False),
        (1.4999999, 1.0, True),
        (0.75, -0.1, True),
        (3.0, 0.75, False),
    ],
)
def test_missing_rays_are_active_only_in_the_turn(s, f, active):
    """Where 0 < s < W and f <= W + 1."""
    assert in_turn(cars((s, f), 1), 1.5)[0] == active
    drawn = draw(Faults(missing=5), runs=1)
    scan = drawn(0, cars((s, f), 1), np.ones((RAYS, 1)))
    assert (scan == 5.0).any() == active


def test_missing_rays_may_be_active_everywhere():
    drawn = draw(Faults(missing=5, turn_only=False))
    assert (drawn(0, cars(IN_HALL), np.ones((RAYS, RUNS)))[drawn.gone] == 5.0).all()


def test_noise_is_uniform_fresh_and_clipped():
    drawn = draw(Faults(noise=0.2))
    scan = np.linspace(1.0, 5.0, RAYS)[:, None] * np.ones(RUNS)
    first, second = (drawn(step, cars(IN_HALL), scan) for step in range(2))
    added = first - scan
    assert added.min() >= 0
    assert added.max() <= 0.2
    assert (first <= 5.0).all()
    assert (first[-1] == 5.0).all()
    # The rays that cannot be clipped: mean 0.1, standard deviation 0.2 / sqrt 12.
    free = added[:-1]
    assert free.mean() == pytest.approx(0.1, abs=4 * 0.2 / math.sqrt(12 * free.size))
    assert free.std() == pytest.approx(0.2 / math.sqrt(12), rel=0.02)
    assert np.abs(first - second)[:-1].max() > 0.1
    assert abs(np.corrcoef(added[3], added[4])[0, 1]) < 0.1


def test_the_papers_faults_are_missing_rays_and_noise():
    assert FAULTS["paper"] == Faults(missing=5, turn_only=True, noise=0.2)
    drawn = draw(FAULTS["paper"])
    faulty = drawn(0, cars(IN_TURN), np.full((RAYS, RUNS), 3.0))
    assert (faulty[drawn.gone] == 5.0).all()
    assert ((faulty >= 3.0) & (faulty <= 3.2))[~drawn.gone].all()


def test_no_faults_leave_the_scan_alone():
    scan = np.random.default_rng(0).uniform(0, 5, (RAYS, RUNS))
    assert (draw(FAULTS["none"])(0, cars(IN_TURN), scan) == scan).all()


def test_a_seed_gives_the_same_faults_again():
    scan = np.ones((RAYS, RUNS))
    one, two, other = (draw(FAULTS["paper"], seed) for seed in (7, 7, 8))
    assert (one.gone == two.gone).all()
    for step in range(3):
        a, b, c = (x(step, cars(IN_TURN), scan) for x in (one, two, other))
        assert (a == b).all()
        assert not (a == c).all()


@pytest.mark.parametrize("wrong", [{"missing": -1}, {"noise": -0.1}, {"noise": math.nan}])
def test_wrong_faults_are_refused(wrong):
    with pytest.raises(BadInput, match="faults"):
        Faults(**wrong)


# --- Faults that are given ---------------------------------------------------------------


def reading(distance: float, noise: float, missing: bool) -> float:
    """Say what one ray reads, as the instances define it."""
    return 5.0 if missing else max(0.0, min(5.0, distance + noise))


@given(
    seed=st.integers(0, 2**32 - 1),
    turn_only=st.booleans(),
    per_step=st.booleans(),
    noisy=st.booleans(),
)
def test_given_faults_are_noise_then_clipping_then_missing_rays(seed, turn_only, per_step, noisy):
    random = np.random.default_rng(seed)
    steps, rays, runs = 3, 4, 5
    scan = random.uniform(0, 5, (steps, rays, runs))
    noise = random.uniform(-3, 3, (steps, rays, runs)) if noisy else None
    gone = random.random((steps, rays, runs) if per_step else (rays, runs)) < 0.4
    places = [IN_TURN if random.random() < 0.5 else IN_HALL for _ in range(runs)]
    state = State.start([s for s, _ in places], [f for _, f in places])
    faults = GivenFaults(1.5, 5.0, gone, turn_only, noise)
    for step in range(steps):
        found = faults(step, state, scan[step])
        for ray in range(rays):
            for run in range(runs):
                missing = gone[step, ray, run] if per_step else gone[ray, run]
                active = places[run] == IN_TURN or not turn_only
                expected = reading(
                    scan[step, ray, run],
                    noise[step, ray, run] if noisy else 0.0,
                    bool(missing and active),
                )
                assert found[ray, run] == expected


def test_nothing_given_leaves_the_scan_alone():
    scan = np.random.default_rng(0).uniform(0, 5, (RAYS, RUNS))
    assert (GivenFaults(1.5, 5.0)(0, cars(IN_TURN), scan) == scan).all()


@pytest.mark.parametrize("place", [IN_TURN, IN_HALL])
def test_drawn_faults_given_value_by_value_are_the_same(place):
    drawn = draw(FAULTS["paper"])
    again = np.random.default_rng(0)  # the generator that drew them
    again.integers(RAYS, size=(5, RUNS))
    values = 0.2 * again.random((RUNS, RAYS)).T
    scan = np.random.default_rng(1).uniform(0, 5, (RAYS, RUNS))
    given_faults = GivenFaults(1.5, 5.0, drawn.gone, True, values[None])
    state = cars(place)
    assert (given_faults(0, state, scan) == drawn(0, state, scan)).all()

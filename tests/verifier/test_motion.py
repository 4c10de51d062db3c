"""One step of the car on Taylor models, against the equations of motion in Arb."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_members import arb, excess, member, places, random_models, worst_excess
from hypothesis import given, settings
from hypothesis import strategies as st

from racecar.bicycle import Bicycle
from verifier.arithmetic import Model
from verifier.models import TERMS, Models, stack
from verifier.motion import Motion, sinc, slip_pair
from verifier.rows import THETA, F, S, V

SEEDS = st.integers(0, 2**32 - 1)
ROWS = 3


def exact_sinc(x: arb) -> arb:
    return x.sinc()


@settings(max_examples=60)
@given(SEEDS, st.sampled_from([0.0, 1e-9, 1e-3, 0.1]), st.sampled_from([0.0, 1e-8, 1e-2]))
def test_sinc(seed, width, error):
    random = np.random.default_rng(seed)
    z = random_models(random, (ROWS,), width, 2, error, random.choice([0.0, 1e-3, 0.2]))
    result = sinc(z)
    finite = np.isfinite(result.radius)
    assert worst_excess([z[finite]], result[finite], exact_sinc, random) <= 1


def test_sinc_up_to_its_limit():
    """At |x| = 1 the part cut off is nearly all of the radius, and all members are held."""
    z = Models(np.array([[0.9999], *[[0.0]] * 5]), np.zeros(1))
    result = sinc(z)
    off = abs(exact_sinc(arb(0.9999)) - arb(float(result.c[0, 0])))
    assert 0.5 < float(off / arb(float(result.radius[0]))) < 1
    beyond = Models(np.array([[1.01], *[[0.0]] * 5]), np.zeros(1))
    assert sinc(beyond).radius[0] == np.inf


@settings(max_examples=60)
@given(SEEDS, st.sampled_from([0.0, 1e-9, 1e-3, 0.05]), st.sampled_from([0.0, 1e-8, 1e-2]))
def test_slip_angles(seed, width, error):
    random = np.random.default_rng(seed)
    z = random_models(random, (ROWS,), width, 2, error, random.choice([0.0, 0.13]))
    cosine, sine = slip_pair(z)
    finite = np.isfinite(cosine.radius) & np.isfinite(sine.radius)
    z, cosine, sine = z[finite], cosine[finite], sine[finite]
    assert worst_excess([z], cosine, lambda t: t.atan().cos(), random) <= 1
    assert worst_excess([z], sine, lambda t: t.atan().sin(), random) <= 1


def test_slip_up_to_its_limit():
    z = Models(np.array([[0.4999], *[[0.0]] * 5]), np.zeros(1))
    cosine = slip_pair(z)[0]
    off = abs(arb(0.4999).atan().cos() - arb(float(cosine.c[0, 0])))
    assert 0.1 < float(off / arb(float(cosine.radius[0]))) < 1
    beyond = slip_pair(Models(np.array([[0.51], *[[0.0]] * 5]), np.zeros(1)))
    assert beyond[0].radius[0] == np.inf


def car_constants(car: Bicycle, period: float) -> tuple[arb, ...]:
    """Return top speed, and how much of speed is left, and the distance per speed, of a period."""
    top = arb(car.motor) * (arb(car.throttle) - arb(car.hysteresis))
    decay = (-arb(car.acceleration) * arb(period)).exp()
    return top, decay, (1 - decay) / arb(car.acceleration)


CARS = st.sampled_from(
    [
        (Bicycle(), 0.1),
        (Bicycle(slip=True), 0.1),
        (Bicycle(acceleration=30.0, front=0.1, rear=0.3, slip=True), 0.05),
        (Bicycle(acceleration=1e-3, throttle=4.0), 0.2),
        (Bicycle(acceleration=1e4), 0.1),
    ]
)


@given(CARS)
def test_constants_hold_their_real_values(case):
    car, period = case
    motion = Motion(car, period)
    top, decay, gone = car_constants(car, period)
    base = 1 / (arb(car.front) + arb(car.rear))
    pairs = [
        (motion._top, top),
        (motion._decay, decay),
        (motion._gone, gone),
        (motion._coast, top * (arb(period) - gone)),
        (motion._inverse_base, base),
    ]
    if car.slip:
        pairs.append((motion._rear_share, arb(car.rear) * base))
    for real, exact in pairs:
        assert abs(arb(real.value) - exact) <= arb(real.error)
        assert real.error <= 1e-11 * max(1.0, abs(real.value))


def exact_step(car: Bicycle, period: float, state: list[arb], steering: arb, share: float = 1.0):
    """Return the state after a period; s and f after a share of the distance instead."""
    s, f, v, theta = state
    top, decay, gone = car_constants(car, period)
    base = arb(car.front) + arb(car.rear)
    beta = (arb(car.rear) * steering.tan() / base).atan() if car.slip else arb(0)
    curvature = beta.cos() * steering.tan() / base
    distance = top * arb(period) + (v - top) * gone
    part = distance * arb(share)
    half = curvature * part / 2
    chord, course = part * half.sinc(), theta + beta + half
    after = [s - chord * course.sin(), f - chord * course.cos()]
    return [*after, top + (v - top) * decay, theta + curvature * distance]


def states(random: np.random.Generator, width: float, error: float) -> tuple[Models, Models]:
    state = random_models(random, (4, ROWS), width, 3, error, 0.0)
    state.c[0] = np.array([[0.7], [9.0], [1.0], [0.1]]) + 0.3 * random.normal(size=(4, ROWS))
    state.c[TERMS:, V] = 0.0
    steering = random_models(random, (ROWS,), width, 3, error, 0.15)
    return state, steering


@settings(max_examples=25)
@given(SEEDS, CARS, st.sampled_from([(0.0, 0.0), (1e-6, 1e-9), (1e-2, 1e-3), (0.1, 0.0)]))
def test_steps_hold_every_member(seed, case, sizes):
    (car, period), random = case, np.random.default_rng(seed)
    state, steering = states(random, *sizes)
    path = Motion(car, period).drive(state, steering)
    quarter = path.point(0.25)
    for row in np.flatnonzero(np.isfinite(path.state.radius).all(axis=0)):
        for place in places(random, 3):
            rests = random.choice([-1.0, 1.0], 5)
            start = [member(state, (i, row), place, rests[i]) for i in range(4)]
            steer = member(steering, (row,), place, rests[4])
            end = exact_step(car, period, start, steer)
            for i in (S, F, V, THETA):
                assert excess(path.state, (i, row), place, end[i]) <= 1
            part = exact_step(car, period, start, steer, 0.25)
            for i in (S, F):
                assert excess(quarter, (i, row), place, part[i]) <= 1


def test_steps_of_plain_states_are_finite():
    random = np.random.default_rng(0)
    for slip in (False, True):
        path = Motion(Bicycle(slip=slip), 0.1).drive(*states(random, 1e-3, 1e-6))
        assert np.isfinite(path.state.radius).all()
        assert (path.state.radius < 1e-4).all()


@pytest.mark.parametrize("name", ["_top", "_decay", "_gone", "_coast", "_inverse_base"])
def test_the_check_sees_a_constant_whose_error_is_not_counted(name):
    """Each constant is rounded: without its error a step at rest, or at speed, is off."""
    car, period = Bicycle(motor=0.1, front=0.1, rear=0.2), 0.1
    motion = Motion(car, period)
    real = getattr(motion, name)
    exact = {
        "_top": car_constants(car, period)[0],
        "_decay": car_constants(car, period)[1],
        "_gone": car_constants(car, period)[2],
        "_coast": car_constants(car, period)[0] * (arb(period) - car_constants(car, period)[2]),
        "_inverse_base": 1 / (arb(car.front) + arb(car.rear)),
    }[name]
    without = replace(real, error=0.0)
    assert abs(arb(without.value) - exact) > arb(without.error)


def test_the_check_sees_a_sinc_cut_off_too_early(monkeypatch):
    """The radius at the limit is mostly what is cut off: a tenth of it does not hold."""
    z = Models(np.array([[0.9999], *[[0.0]] * 5]), np.zeros(1))
    widen = Model.widen
    monkeypatch.setattr(Model, "widen", lambda self, amount: widen(self, amount * 0.1))
    result = sinc(z)
    off = abs(exact_sinc(arb(0.9999)) - arb(float(result.c[0, 0])))
    assert off > arb(float(result.radius[0]))


def test_steering_without_bound_gives_nothing_finite():
    """A linear output layer may steer beyond 1 rad: the step must not be claimed."""
    random = np.random.default_rng(0)
    state, steering = states(random, 1e-3, 0.0)
    steering.c[0] = [0.999, 1.2, -30.0]
    with np.errstate(invalid="ignore"):
        path = Motion(Bicycle(), 0.1).drive(state, steering)
    assert not np.isfinite(path.state.radius[[S, F, THETA]]).all(axis=0)[1:].any()


def test_points_of_the_path_begin_and_end_where_the_step_does():
    random = np.random.default_rng(1)
    state, steering = states(random, 1e-3, 1e-6)
    path = Motion(Bicycle(slip=True), 0.1).drive(state, steering)
    end = path.point(1.0)
    assert (end.c == stack([path.state[S], path.state[F]]).c).all()

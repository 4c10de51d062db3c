"""The arcs, against the differential equations that they solve."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from racecar.bicycle import Arc, Bicycle
from racecar.errors import BadInput

CARS = st.builds(
    Bicycle,
    throttle=st.floats(4, 20),
    acceleration=st.floats(0.2, 4),
    motor=st.floats(0.05, 0.5),
    front=st.floats(0.1, 0.5),
    rear=st.floats(0.1, 0.5),
    slip=st.booleans(),
)
#: At rest or really moving: the solver's own error estimate underflows in between.
SPEEDS = st.one_of(st.just(0.0), st.floats(1e-3, 3))


def ode(car: Bicycle, start: list[float], steering: float, time: float) -> np.ndarray:
    """Integrate the equations of DESIGN.md, section 1: (s, f, v, theta) after ``time``."""
    wheelbase = car.front + car.rear
    beta = math.atan(car.rear * math.tan(steering) / wheelbase) if car.slip else 0.0

    def slope(_: float, x: np.ndarray) -> list[float]:
        _, _, v, theta = x
        return [
            -v * math.sin(theta + beta),
            -v * math.cos(theta + beta),
            -car.acceleration * v + car.acceleration * car.motor * (car.throttle - car.hysteresis),
            v * math.cos(beta) * math.tan(steering) / wheelbase,
        ]

    solution = solve_ivp(slope, (0, time), start, method="DOP853", rtol=1e-12, atol=1e-13)
    return solution.y[:, -1]


def drive(car: Bicycle, start: list[float], steering: float, time: float) -> np.ndarray:
    s, f, v, theta = (np.array([x]) for x in start)
    arc, theta_after = car.arc(s, f, v, theta, np.array([steering]), time)
    return np.array([*arc.end, car.speed_after(v, time), theta_after])[:, 0]


@given(
    car=CARS,
    start=st.tuples(st.floats(0, 20), st.floats(0, 20), SPEEDS, st.floats(-math.pi, math.pi)),
    steering=st.floats(-1.2, 1.2),
    time=st.floats(0.001, 1.0),
)
def test_arcs_agree_with_an_ode_solver(car, start, steering, time):
    expected = ode(car, list(start), steering, time)
    assert np.abs(drive(car, list(start), steering, time) - expected).max() < 1e-9


@pytest.mark.parametrize("slip", [False, True])
def test_a_whole_run_of_arcs_agrees_with_an_ode_solver(slip):
    car = Bicycle(slip=slip)
    state = [0.75, 9.9, 0.0, 0.0]
    expected = np.array(state)
    for step in range(70):
        steering = math.radians(15) * math.sin(0.3 * step)
        expected = ode(car, list(expected), steering, 0.1)
        state = list(drive(car, state, steering, 0.1))
    assert np.abs(np.array(state) - expected).max() < 1e-9


def test_without_steering_the_path_is_straight():
    car = Bicycle()
    s, f, v, theta = drive(car, [1.0, 9.0, 2.0, 0.5], 0.0, 0.1)
    distance = car.distance_after(2.0, 0.1)
    assert s == pytest.approx(1 - distance * math.sin(0.5), abs=1e-15)
    assert f == pytest.approx(9 - distance * math.cos(0.5), abs=1e-15)
    assert theta == 0.5
    assert v > 2.0


@pytest.mark.parametrize("curvature", [0.0, 5e-324, 1e-300, 1e-12, -1e-12, 1e-8])
def test_a_tiny_curvature_is_as_good_as_none(curvature):
    one = np.ones(1)
    arc = Arc(one, one, 0.3 * one, curvature * one, 0.24 * one)
    # The path leaves the straight line by at most curvature * distance^2 / 2.
    assert arc.end[0][0] == pytest.approx(1 - 0.24 * math.sin(0.3), abs=1e-15 + abs(curvature))
    assert arc.end[1][0] == pytest.approx(1 - 0.24 * math.cos(0.3), abs=1e-15 + abs(curvature))


def test_a_car_at_rest_stays_for_no_time():
    assert drive(Bicycle(), [0.7, 9.9, 0.0, 0.1], 0.2, 0.0) == pytest.approx([0.7, 9.9, 0, 0.1])


def test_a_full_circle_ends_where_it_began():
    one = np.ones(1)
    arc = Arc(one, 2 * one, 0.4 * one, 0.5 * one, 4 * math.pi * one)
    assert arc.end[0][0] == pytest.approx(1, abs=1e-14)
    assert arc.end[1][0] == pytest.approx(2, abs=1e-14)


@given(CARS, st.floats(0, 3), st.floats(0.01, 2))
def test_distance_is_the_integral_of_speed(car, v, time):
    # Simpson's rule on 200 intervals; its error is far below the tolerance here.
    t = np.linspace(0, time, 401)
    speed = car.speed_after(v, t)
    simpson = (t[1] - t[0]) / 3 * (speed[0] + 4 * speed[1::2].sum() + 2 * speed[2:-1:2].sum())
    simpson += (t[1] - t[0]) / 3 * speed[-1]
    assert car.distance_after(v, time) == pytest.approx(simpson, abs=1e-9)


@pytest.mark.parametrize(
    "wrong",
    [
        {"front": 0.0},
        {"rear": -1.0},
        {"motor": math.nan},
        {"acceleration": math.inf},
        {"throttle": 3.0},
        {"throttle": math.inf},
        {"hysteresis": math.nan},
    ],
)
def test_wrong_parameters_are_refused(wrong):
    with pytest.raises(BadInput, match="bicycle"):
        Bicycle(**wrong)

"""The teacher: its line, that it follows it, and how much room it keeps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from generator.hyperparams import load_hyperparameters
from generator.instances import benchmark_plant
from generator.robust.teacher import Teacher
from racecar.closed_loop import State
from racecar.env import MAX_STEERING
from racecar.safety import named_property

TEACHER = Teacher(**load_hyperparameters("ROBUST").teacher.model_dump())


def drive(start, steps):
    """Return the least margin of each run and how often it changed halls."""
    plant = benchmark_plant(21, math.radians(230))
    safety = named_property("clearance", plant.track)
    least, turns, state = np.full(len(start), np.inf), np.zeros(len(start), int), start
    for _ in range(steps):
        after, arc = plant.drive(state, TEACHER(state.s, state.f, state.theta))
        least = plant.arc_margin(safety, state, arc, least)
        state, before = plant.advance(after), state.frame
        turns += state.frame != before
    return least, turns


def test_it_drives_laps_with_a_wide_margin():
    least, turns = drive(State.start(np.linspace(0.65, 0.85, 21)), 330)
    assert (turns >= 4).all()
    assert least.min() > 0.13


def test_it_is_safe_from_the_papers_starts():
    """Where the car starts 0.25 m from the margin's end and heads for it, less is left."""
    s, theta = np.meshgrid(np.linspace(0.55, 0.95, 9), np.linspace(-0.3, 0.3, 7))
    least, turns = drive(State.start(s.ravel(), 10.0, 0.0, theta.ravel()), 75)
    assert (turns == 1).all()
    assert least.min() > 0.04


@given(st.floats(-3, 6))
def test_the_line_is_a_straight_a_quarter_circle_and_a_straight(along):
    s, f = TEACHER.line(np.array(along))
    quarter, centre = math.pi / 2 * TEACHER.radius, TEACHER.lane + TEACHER.radius
    if along < 0:
        assert (s, f) == pytest.approx((TEACHER.lane, centre - along))
    elif along > quarter:
        assert (s, f) == pytest.approx((centre + along - quarter, TEACHER.lane))
    else:
        assert math.hypot(s - centre, f - centre) == pytest.approx(TEACHER.radius)
        assert s == pytest.approx(centre - TEACHER.radius * math.cos(along / TEACHER.radius))


@given(st.floats(-3, 6))
def test_the_nearest_point_of_a_point_of_the_line_is_itself(along):
    assert TEACHER.nearest(*TEACHER.line(np.array(along))) == pytest.approx(along, abs=1e-9)


@given(st.floats(-3, 6), st.floats(-0.3, 0.3))
def test_the_nearest_point_is_found_beside_the_line(along, aside):
    """Against a search over points of the line 1 mm apart."""
    s, f = TEACHER.line(np.array(along))
    s = s + aside
    places = np.linspace(-4, 8, 12001)
    line = TEACHER.line(places)
    found = TEACHER.line(TEACHER.nearest(s, f))
    assert math.hypot(found[0] - s, found[1] - f) <= np.hypot(line[0] - s, line[1] - f).min() + 1e-6


def test_the_steering_bends_the_path_through_the_point_aimed_at():
    """On the straight, 0.1 m left of the line, the arc of the answer meets the line ahead."""
    s, f = TEACHER.lane - 0.1, 9.0
    steering = TEACHER(np.array([s]), np.array([f]), np.array([0.0]))[0]
    curvature = math.tan(steering) / 0.45
    # The line's nearest point lies abreast; the point aimed at is look_straight ahead of that,
    # 0.1 m to the right, and a circle through it has this curvature.
    distance = math.hypot(TEACHER.look_straight, 0.1)
    assert curvature == pytest.approx(-2 * 0.1 / distance**2)


def test_steering_stays_within_the_cars():
    answers = TEACHER(np.full(9, 0.4), np.full(9, 1.0), np.linspace(-1.5, 1.5, 9))
    assert np.abs(answers).max() == MAX_STEERING

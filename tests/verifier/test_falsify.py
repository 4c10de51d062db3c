"""Falsification finds the worst start where it is known, keeps to its time, and repeats."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from enclosed import zero_controller
from falsified import MIDDLE, RAYS, disturbance, driven, linear, problem, search
from instances import everywhere
from whole_runs import random_controller

from racecar.controller import RuntimeSteer
from verifier.falsify import confirmed


def test_a_gap_in_one_dimension_is_found_however_small():
    """Straight ahead; unsafe is a strip of 20 um, between the points of a grid of 0.4 mm."""
    question = problem(zero_controller(RAYS), [0.65, 9.9, 0, 0], [0.85, 9.9, 0, 0])
    strip = [[-1.0, 0.0, -0.71231], [1.0, 0.0, 0.71233]]
    question = replace(question, safety=everywhere("strip", question.plant.track, strip))
    worst = search(question)
    assert 0.71231 <= worst.start[0] <= 0.71233
    assert worst.margin <= 0
    assert confirmed(question, RuntimeSteer(question.controller), worst)


def test_the_worst_corner_of_a_box_is_found():
    """Straight ahead at an angle: the left wall is nearest for a corner, after the last step."""
    lower, upper = [0.6, 9.8, 0.5, -0.1], [0.7, 9.9, 1.0, 0.1]
    question = problem(zero_controller(RAYS), lower, upper)
    expected = 0.6 - driven(1.0, 1.0) * math.sin(0.1) - 0.3
    worst = search(question)
    assert worst.margin == pytest.approx(expected, abs=1e-4)
    assert worst.margin >= expected - 1e-12


@pytest.mark.parametrize("seed", range(3))
def test_an_unsafe_place_inside_a_box_of_four_dimensions_is_found(seed):
    """A post of 4 mm on the way of few starts: s, theta and the place must fit together."""
    lower, upper = [0.6, 9.7, 0.0, -0.2], [0.9, 9.9, 2.0, 0.2]
    question = problem(zero_controller(RAYS), lower, upper)
    s, f = 0.9, 9.0
    post = [[-1.0, 0.0, 0.002 - s], [1.0, 0.0, s + 0.002], [0.0, -1.0, 0.002 - f], [0.0, 1.0, f]]
    question = replace(question, safety=everywhere("post", question.plant.track, post))
    worst = search(question, seed)
    assert worst.margin <= 0
    # Its straight line passes the post.
    aside = worst.start[0] - (worst.start[1] - f) * math.tan(worst.start[3]) - s
    assert abs(aside) <= 0.003


def test_a_point_is_simulated_as_it_is():
    question = problem(zero_controller(RAYS), [0.7, 9.9, 0, 0], [0.7, 9.9, 0, 0])
    worst = search(question)
    assert worst.start.tolist() == [0.7, 9.9, 0, 0]
    assert worst.margin == pytest.approx(0.4, abs=1e-12)
    assert worst.witness() == {"s": 0.7, "f": 9.9, "v": 0.0, "theta": 0.0}


@pytest.mark.parametrize("given_disturbance", [None, disturbance(0.01, 1, choice="step")])
def test_the_same_seed_finds_the_same(given_disturbance):
    question = problem(
        random_controller(np.random.default_rng(5), 9, "tanh"),
        [0.7, 5.0, 1.0, 0.0],
        [0.8, 5.1, 1.0, 0.0],
        disturbance=given_disturbance,
    )
    one, two = (search(question, seed=3, runs=1500).witness() for _ in range(2))
    assert one == two


def test_a_network_that_answers_nan_is_not_unsafe():
    broken = linear({MIDDLE - 1: 3e38, MIDDLE: -3e38})  # infinity less infinity
    for given_disturbance in (None, disturbance(0.01, 1)):
        question = problem(
            broken, [0.7, 5.0, 1.0, 0.0], [0.8, 5.1, 1.0, 0.0], disturbance=given_disturbance
        )
        worst = search(question, runs=800)
        assert worst.margin > 0
        assert not confirmed(question, RuntimeSteer(broken), worst)


def test_the_search_keeps_to_its_time():
    question = problem(
        random_controller(np.random.default_rng(1), 21, "tanh"),
        [0.7, 9.9, 0.0, 0.0],
        [0.8, 9.9, 0.0, 0.0],
        disturbance=disturbance(0.001),
    )
    began = time.monotonic()
    search(question, runs=10**9, seconds=1.0)
    assert time.monotonic() - began < 60

"""Falsification finds the worst disturbance where it is known, as the harness replays it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from enclosed import zero_controller
from falsified import (
    MIDDLE,
    NOWHERE,
    RAYS,
    WALLS,
    disturbance,
    driven,
    linear,
    problem,
    replayed,
    search,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import everywhere
from whole_runs import random_controller

from harness.records import WitnessOutcome
from racecar.closed_loop import State, simulate
from racecar.controller import RuntimeSteer
from racecar.faults import GivenFaults
from racecar.mirrors import mirroring
from verifier.falsify import confirmed
from verifier.problem import Problem, load_problem
from verifier.starts import spread
from verifier.verify import verify

ROOT = Path(__file__).parents[2]


def test_the_worst_noise_is_found_where_it_is_known():
    """The middle ray reads its range, 5 m; noise below 0 turns the car right, above 0 not at all.

    So the worst is a circle to the right with all of the noise, and the left wall of the block
    (s >= 1.2) comes nearest at its end.
    """
    question = problem(
        linear({MIDDLE: 2.0}, -10.0),
        [0.7, 9.9, 1.0, 0.0],
        [0.7, 9.9, 1.0, 0.0],
        disturbance=disturbance(noise=0.02),
    )
    curvature = math.tan(-0.04) / 0.45
    turned = curvature * driven(1.0, 1.0)
    expected = 1.2 - (0.7 + (math.cos(turned) - 1) / curvature)
    worst = search(question)
    assert worst.margin == pytest.approx(expected, abs=1e-6)
    assert worst.noise is not None
    assert np.all(worst.noise[:, MIDDLE] == -0.02)


@pytest.mark.parametrize("ray", [3, 17])
def test_the_ray_whose_loss_is_worst_is_found(ray, tmp_path):
    """Only one ray of those that see a wall decides; if it is missing, the car turns left."""
    question = problem(
        linear({ray: 0.02, MIDDLE: 0.3}, -1.5),
        [0.7, 9.9, 2.0, 0.0],
        [0.72, 9.9, 2.0, 0.0],
        disturbance=disturbance(missing=1),
        steps=15,
    )
    worst = search(question)
    assert worst.missing is not None
    assert np.flatnonzero(worst.missing).tolist() == [ray]
    assert worst.witness()["missing"] == [ray]
    assert replayed(question, worst, tmp_path).margin == worst.margin


def every_choice(question: Problem, start: np.ndarray) -> float:
    """Return the least margin from one start over every set of missing rays and every segment."""
    plant, rays, given_set = question.plant, question.plant.lidar.rays, question.disturbance
    some = [x for k in range(given_set.missing + 1) for x in combinations(range(rays), k)]
    gone = np.array([[ray in x for x in some] for ray in range(rays)])
    mirrors, sets = None, gone.shape[1]
    if given_set.mirrors is not None:
        count = len(given_set.mirrors.segments) + 1
        chosen = np.repeat(np.arange(count) - 1, sets)
        gone, mirrors = np.tile(gone, count), mirroring(given_set.mirrors, plant, chosen)
    faults = GivenFaults(
        plant.track.width, plant.lidar.range, gone, given_set.turn_only, mirrors=mirrors
    )
    state = State.start(*np.repeat(start[:, None], gone.shape[1], axis=1))
    steer = question.controller.steering_rows
    return simulate(plant, steer, question.safety, state, question.steps, faults).margin.min()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("choice", ["run", "step"])
def test_no_single_missing_ray_is_worse_than_what_is_found(seed, choice):
    random = np.random.default_rng(seed)
    question = problem(
        random_controller(random, 9, "tanh"),
        [0.75, 5.0, 2.0, 0.0],
        [0.75, 5.0, 2.0, 0.0],
        disturbance=disturbance(missing=1, choice=choice, turn_only=seed % 2 == 1),
        steps=12,
    )
    brute = every_choice(question, question.lower)
    assert search(question).margin <= max(brute, 0.0) + 1e-6


@pytest.mark.parametrize("stretch", [0, 1, 2])
def test_the_stretch_whose_mirror_is_worst_is_found(stretch, tmp_path):
    """Unsafe is where the car gets if that stretch mirrors, and only then."""
    random = np.random.default_rng(2)
    controller = linear(dict(enumerate(random.uniform(-0.005, 0.005, RAYS))))
    point = [0.75, 4.0, 2.4, 0.0]
    question = problem(controller, point, point, disturbance=disturbance(mirrors=WALLS), steps=12)
    plant, steer = question.plant, question.controller.steering_rows
    ends, nowhere = [], everywhere("nowhere", plant.track, NOWHERE)
    for chosen in range(-1, 8):
        mirrors = mirroring(WALLS, plant, chosen)
        faults = GivenFaults(plant.track.width, plant.lidar.range, mirrors=mirrors)
        trace = simulate(plant, steer, nowhere, State.start(*point), 12, faults, record=True).trace
        ends.append((float(trace["s"][0, -1]), float(trace["f"][0, -1])))
    s, f = ends[stretch + 1]
    half = min(math.dist((s, f), e) for i, e in enumerate(ends) if i != stretch + 1) / 4
    assert half > 1e-5
    post = [
        [-1.0, 0.0, half - s], [1.0, 0.0, s + half], [0.0, -1.0, half - f], [0.0, 1.0, f + half],
    ]  # fmt: skip
    question = replace(question, safety=everywhere("post", plant.track, post))
    worst = search(question)
    assert worst.witness()["mirror"] == stretch
    assert worst.missing is None
    found = replayed(question, worst, tmp_path)
    assert found.outcome is WitnessOutcome.CORRECT
    assert found.margin == worst.margin


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("missing", [0, 1, 2])
def test_no_stretch_with_any_missing_rays_is_worse_than_what_is_found(seed, missing):
    random = np.random.default_rng(seed)
    question = problem(
        random_controller(random, 9, "tanh"),
        [0.72, 4.0, 2.0, 0.0],
        [0.78, 4.0, 2.0, 0.0],
        disturbance=disturbance(missing=missing, turn_only=seed % 2 == 1, mirrors=WALLS),
        steps=12,
    )
    brute = min(
        every_choice(question, np.array([s, 4.0, 2.0, 0.0])) for s in np.linspace(0.72, 0.78, 9)
    )
    assert search(question).margin <= max(brute, 0.0) + 1e-6


def test_where_a_wall_may_mirror_nothing_is_proved(monkeypatch):
    """The car goes straight on whatever it sees: safe, but the proof does not know mirrors."""
    for missing in (0, 1):
        question = problem(
            zero_controller(RAYS),
            [0.7, 9.9, 0.0, 0.0],
            [0.72, 9.9, 0.0, 0.0],
            disturbance=disturbance(missing=missing, mirrors=WALLS),
        )
        question = replace(question, safety=everywhere("nowhere", question.plant.track, NOWHERE))
        # Runs that are long are proved by induction, if at all.
        for long in (1000, 9):
            monkeypatch.setattr("verifier.verify.LONG", long)
            answer = verify(question, RuntimeSteer(question.controller), timeout=0.5)
            assert answer.verdict == "unknown"
            assert "mirror" in answer.note


def test_rays_that_change_from_step_to_step_can_do_more():
    """One ray turns the car left if it is missing, another one right.

    Unsafe is a post where the car gets by a swerve, one way, then the other: no single missing
    ray leads there.
    """
    steps, left, right = 14, 4, 16
    point = [0.75, 9.9, 2.0, 0.0]
    question = problem(linear({left: 0.015, right: -0.015}), point, point, steps=steps)
    plant, steer = question.plant, question.controller.steering_rows
    swerve = np.zeros((steps, RAYS, 1), dtype=bool)
    swerve[: steps // 2, right] = swerve[steps // 2 :, left] = True
    faults = GivenFaults(plant.track.width, plant.lidar.range, swerve, turn_only=False)
    trace = simulate(
        plant, steer, question.safety, State.start(*question.lower), steps, faults, record=True
    ).trace
    s, f, half = float(trace["s"][0, -1]), float(trace["f"][0, -1]), 0.015
    post = [
        [-1.0, 0.0, half - s], [1.0, 0.0, s + half], [0.0, -1.0, half - f], [0.0, 1.0, f + half],
    ]  # fmt: skip
    question = replace(
        question,
        safety=everywhere("post", plant.track, post),
        disturbance=disturbance(missing=1, choice="step"),
    )
    assert every_choice(question, question.lower) > 0
    worst = search(question)
    assert worst.margin <= 0
    assert worst.missing is not None
    assert len({tuple(row) for row in worst.witness()["missing"]}) > 1


@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**32 - 1),
    noise=st.sampled_from([0.0, 0.002, 0.3]),
    missing=st.integers(0, 3),
    turn_only=st.booleans(),
    choice=st.sampled_from(["run", "step"]),
    activation=st.sampled_from(["tanh", "relu", "sigmoid"]),
    place=st.sampled_from([(2.4, 2.3), (1.5, 6.0), (0.0, 9.9)]),
    mirrors=st.sampled_from([None, WALLS]),
)
def test_what_is_found_is_allowed_and_replayed_to_the_same_margin(
    tmp_path_factory, seed, noise, missing, turn_only, choice, activation, place, mirrors
):
    if not noise and not missing and mirrors is None:
        return
    random = np.random.default_rng(seed)
    v, f = place
    question = problem(
        random_controller(random, 9, activation, 2.0),
        [0.7, f, v, -0.1],
        [0.8, f, v, 0.1],
        disturbance=disturbance(noise, missing, turn_only, choice, mirrors),
        steps=9,
    )
    worst = search(question, runs=600)
    found = replayed(question, worst, tmp_path_factory.mktemp("found"))
    assert found.outside == 0
    assert found.margin == worst.margin
    unsafe = worst.margin <= 0
    assert (found.outcome is WitnessOutcome.CORRECT) == unsafe
    assert confirmed(question, RuntimeSteer(question.controller), worst) == unsafe


def test_noise_of_four_centimetres_drives_a_trained_controller_into_the_corner(tmp_path):
    """Undisturbed it keeps 3 cm more than it must; random noise leaves a third of that."""
    path = ROOT / "benchmarks/full_range/json/TD3_L21_64x64_C1.full_range.clearance.json"
    question = replace(load_problem(path)[1], disturbance=disturbance(noise=0.04))
    plant = question.plant
    starts = spread(question.lower, question.upper, 200, np.random.default_rng(0))
    noise = np.random.default_rng(0).choice([-0.04, 0.04], (70, RAYS, 200))
    by_chance = simulate(
        plant,
        question.controller.steering_rows,
        question.safety,
        State.start(*starts.T),
        70,
        GivenFaults(plant.track.width, plant.lidar.range, noise=noise),
    ).margin
    assert by_chance.min() > 0.01
    worst = search(question)
    assert worst.margin <= 0
    assert replayed(question, worst, tmp_path).outcome is WitnessOutcome.CORRECT

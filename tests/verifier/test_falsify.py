"""Falsification finds the worst run where it is known, and states it as the harness reads it."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from enclosed import TRACKS, problem_of, zero_controller
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import everywhere, save
from whole_runs import random_controller

from harness.records import WitnessOutcome
from harness.replay import check_witness
from racecar.closed_loop import State, simulate
from racecar.controller import Controller, Layer, RuntimeSteer
from racecar.disturbance import Disturbance, Mirrors
from racecar.faultmodels.spec import Segment
from racecar.faults import GivenFaults
from racecar.instance import load_instance
from racecar.lidar import Lidar
from racecar.mirrors import mirroring
from verifier.falsify import Worst, confirmed, worst_start
from verifier.problem import Problem, load_problem
from verifier.starts import spread
from verifier.verify import verify

ROOT = Path(__file__).parents[2]
RAYS, MIDDLE = 21, 10


def linear(weights: dict[int, float], bias: float = 0.0) -> Controller:
    """Steer linearly in some readings."""
    row = np.zeros((1, RAYS), np.float32)
    for ray, weight in weights.items():
        row[0, ray] = weight
    return Controller((Layer(row, np.array([bias], np.float32), "linear"),))


def disturbance(
    noise=0.0, missing=0, turn_only=False, choice="run", mirrors: Mirrors | None = None
) -> Disturbance:
    return Disturbance(
        noise=noise, missing=missing, turn_only=turn_only, choice=choice, mirrors=mirrors
    )


def outer_walls(*stretches: tuple[float, float], incidence: float = 0.7) -> Mirrors:
    """Return stretches of the first hall's left wall (to the corner at 0) and front wall."""
    segments = [
        Segment(
            hall=0,
            begin=(max(a, 0.0), max(-a, 0.0)),
            end=(max(b, 0.0), max(-b, 0.0)),
        )
        for a, b in stretches
    ]
    return Mirrors(segments=tuple(segments), incidence=incidence)


#: Where no car gets.
NOWHERE = [[-1.0, 0.0, -1e4]]
#: Stretches of a metre, from 4 m before the corner to 4 m beyond it.
WALLS = outer_walls(*((a, a + 1.0) for a in (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)))


def problem(controller: Controller, lower: list[float], upper: list[float], **extra) -> Problem:
    given_extra = {"steps": 10} | extra
    return problem_of(
        TRACKS["square"],
        Lidar(controller.rays),
        controller,
        lower=np.array(lower),
        upper=np.array(upper),
        **given_extra,
    )


def search(question: Problem, seed: int = 0, **options) -> Worst:
    steer = RuntimeSteer(question.controller)
    return worst_start(question, steer, question.lower, question.upper, seed, **options)


def replayed(question: Problem, worst: Worst, folder: Path):
    """Judge a witness as the harness does; return its check."""
    path = save(replace(question, disturbance=None), folder)
    data = json.loads(path.read_text())
    if question.disturbance is not None:
        data["disturbance"] = question.disturbance.model_dump()
    path.write_text(json.dumps(data))
    return check_witness(load_instance(path), path, json.dumps(worst.witness()).encode())


def driven(v: float, time: float) -> float:
    """Return how far the car gets: v' = -1.633 (v - 2.4)."""
    return 2.4 * time - (v - 2.4) * math.expm1(-1.633 * time) / 1.633


# --- Starts ------------------------------------------------------------------------------


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


# --- Disturbances ------------------------------------------------------------------------


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

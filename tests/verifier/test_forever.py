"""Safe for ever: runs driven over many corners stay in the boxes; nothing else is called proved."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from enclosed import TRACKS, problem_of
from instances import everywhere, grown
from whole_runs import tame_controller

from racecar.closed_loop import State, simulate
from racecar.disturbance import Disturbance
from racecar.lidar import Lidar
from racecar.safety import Property, named_property
from racecar.track import Hall, Track, square_track
from verifier import divide
from verifier import forever as under_test
from verifier.forever import Corner, Forever, prove_forever
from verifier.problem import Box, Problem
from verifier.rows import S
from verifier.verify import LONG, verify

SHORT = Lidar(5, math.radians(115), 2.0)
CORNERS = 12


def around(track: Track, **extra) -> Problem:
    given = {
        "steps": LONG + 1,
        "lower": np.array([0.74, 4.0, 2.0, 0.0]),
        "upper": np.array([0.76, 4.0, 2.0, 0.0]),
        "safety": named_property("clearance", track),
    }
    return problem_of(track, SHORT, tame_controller(SHORT, 1.0, 0.8), **(given | extra))


def proved(problem: Problem, seconds: float = 100.0) -> Forever:
    box = Box(problem.lower, problem.upper, S)
    return prove_forever(problem, box, 0.05, time.monotonic() + seconds)


@pytest.fixture(scope="module")
def circle() -> Forever:
    return proved(around(square_track(5.0)))


def arrivals(problem: Problem, starts: np.ndarray, steps: int, disturb=None) -> list[np.ndarray]:
    """Return the states ``[4, runs]`` right after each change of frame of every run."""
    runs = simulate(
        problem.plant, problem.controller.steering_rows, problem.safety, State.start(*starts.T),
        steps, disturb, record=True,
    )  # fmt: skip
    assert (runs.crash_step < 0).all()
    trace = runs.trace
    states = np.stack([trace[name] for name in ("s", "f", "v", "theta")])
    found: list[list[np.ndarray]] = []
    for run in range(len(starts)):
        at = np.flatnonzero(np.diff(trace["frame"][run])) + 1
        for corner, when in enumerate(at[:CORNERS]):
            if corner == len(found):
                found.append([])
            found[corner].append(states[:, run, when])
    assert all(len(states) == len(starts) for states in found)
    return [np.stack(states, axis=1) for states in found]


def box_of_corner(circle: Forever, corner: int) -> Corner:
    """Return the box that the runs are in at a corner, counted on and on."""
    count = len(circle.corners)
    if corner >= count:
        corner = circle.returns + (corner - count) % (count - circle.returns)
    return circle.corners[corner]


def test_runs_stay_in_the_boxes_over_many_corners(circle):
    assert circle.proved
    assert 0 <= circle.returns < len(circle.corners)
    problem = around(square_track(5.0))
    starts = problem.lower + np.linspace(0, 1, 101)[:, None] * (problem.upper - problem.lower)
    found = arrivals(problem, starts, 260)
    assert len(found) == CORNERS
    for corner, states in enumerate(found):
        box = box_of_corner(circle, corner)
        assert (states.min(axis=1) >= box.lower - 1e-9).all()
        assert (states.max(axis=1) <= box.upper + 1e-9).all()
    runs = simulate(
        problem.plant, problem.controller.steering_rows, problem.safety, State.start(*starts.T), 260
    )
    assert 0.05 < circle.least <= runs.margin.min() + 1e-9


def test_runs_from_a_corners_box_come_into_the_next(circle):
    """The step of the induction by itself: corners of the box, and random states in it."""
    problem, random = around(square_track(5.0)), np.random.default_rng(0)
    for corner in range(len(circle.corners)):
        box = circle.corners[corner]
        share = np.round(random.random((60, 4)))
        share[30:] = random.random((30, 4))
        states = arrivals(problem, box.lower + share * (box.upper - box.lower), 45)[0]
        after = box_of_corner(circle, corner + 1)
        assert (states.min(axis=1) >= after.lower - 1e-9).all()
        assert (states.max(axis=1) <= after.upper + 1e-9).all()


def test_it_is_said_in_the_verdict():
    problem = around(square_track(5.0))
    result = verify(problem, problem.controller.steering_rows, 100.0)
    assert result.verdict == "unsat"
    assert "for ever" in result.note
    assert result.margin_lower <= result.margin_upper


@pytest.fixture
def hasty():
    """Give up on what is unsafe soon."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(divide, "NARROWEST", 0.5)
        patch.setattr(divide, "MOST_SPLITS", 2)
        yield


@pytest.mark.usefixtures("hasty")
def test_an_unsafe_set_that_is_met_at_every_corner_is_not_proved():
    """The front wall is made thicker, until all runs meet it in the turn."""
    track = square_track(5.0)
    safety = everywhere("front", track, [[0.0, 1.0, 1.2]])
    result = proved(around(track, safety=safety))
    assert not result.proved
    assert result.note == "not proved safe after corner 0"


@pytest.mark.usefixtures("hasty")
def test_an_unsafe_set_that_is_met_later_is_not_proved():
    """From farther left than the corners bring it: the set grows by what the start has left."""
    track = square_track(5.0)
    problem = around(track)
    starts = problem.lower + np.linspace(0, 1, 11)[:, None] * (problem.upper - problem.lower)

    def margins(steps: int) -> float:
        runs = simulate(
            problem.plant, problem.controller.steering_rows, problem.safety, State.start(*starts.T),
            steps,
        )  # fmt: skip
        return float(runs.margin.min())

    first, all_of_them = margins(20), margins(260)
    assert all_of_them < first - 1e-3
    between = replace(problem, safety=grown(problem.safety, (first + all_of_them) / 2))
    result = proved(between, 60.0)
    assert not result.proved
    assert result.note.startswith("not proved safe after corner")


def test_halls_that_are_not_alike_are_not_treated():
    for track in (TRACKS["mixed"], TRACKS["uneven"]):
        result = proved(around(track, safety=named_property("clearance", track)))
        assert not result.proved
        assert "not alike" in result.note
    track = square_track(5.0)
    unsafe = list(named_property("clearance", track).unsafe)
    unsafe[2] = (*unsafe[2], *everywhere("one", track, [[0.0, 1.0, 1.0]]).unsafe[2])
    result = proved(around(track, safety=Property("uneven", tuple(unsafe))))
    assert not result.proved
    assert "not alike" in result.note


def test_other_tracks_whose_halls_are_alike():
    """To the left, and longer halls: proved or not, no run contradicts it."""
    for track in (Track(1.5, (Hall(5.0, "left"),) * 4), square_track(6.0)):
        problem = around(track)
        result = proved(problem)
        assert result.proved
        starts = problem.lower + np.linspace(0, 1, 21)[:, None] * (problem.upper - problem.lower)
        for corner, states in enumerate(arrivals(problem, starts, 200)):
            box = box_of_corner(result, corner)
            assert (states.min(axis=1) >= box.lower - 1e-9).all()
            assert (states.max(axis=1) <= box.upper + 1e-9).all()


def test_no_time_and_too_few_corners(monkeypatch):
    assert "time limit" in proved(around(square_track(5.0)), -1.0).note
    monkeypatch.setattr(under_test, "MOST_CORNERS", 1)
    result = proved(around(square_track(5.0)))
    assert not result.proved
    assert "no circle" in result.note


def test_a_run_that_does_not_come_to_the_next_hall_is_not_proved(monkeypatch):
    monkeypatch.setattr(under_test, "MOST_STEPS", 8)
    assert not proved(around(square_track(5.0))).proved


@pytest.mark.parametrize("spoiled", [None, 3])
def test_every_case_of_missing_rays_is_driven(monkeypatch, spoiled):
    """Case 0 is that of no missing ray: it alone says nothing."""
    given = Disturbance(noise=0.0, missing=1, turn_only=True, choice="run")
    driven: list[int] = []
    original = under_test.Prover.prove

    def watched(self, box, low, high, tolerance, case=0, frame=0):
        driven.append(case)
        result = original(self, box, low, high, tolerance, 0, frame)
        if case == spoiled:
            return replace(result, low=np.array([0.0]), high=np.array([0.5]))
        return result

    monkeypatch.setattr(under_test.Prover, "prove", watched)
    result = proved(around(square_track(5.0), disturbance=given))
    assert result.proved == (spoiled is None)
    assert set(driven) == set(range(6 if spoiled is None else spoiled + 1))


def test_boxes_contain_what_is_inside_only():
    box = Corner(np.zeros(4), np.ones(4))
    assert box.contains(box)
    assert box.grown().contains(box)
    assert not box.contains(box.grown())
    for i in range(4):
        moved = np.zeros(4)
        moved[i] = 1e-12
        assert not box.contains(Corner(np.zeros(4), np.ones(4) + moved))
        assert not box.contains(Corner(np.zeros(4) - moved, np.ones(4)))
    assert not box.contains(Corner(np.full(4, np.nan), np.ones(4)))

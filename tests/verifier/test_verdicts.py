"""Whole verdicts: unsafe is never called safe, not by a hair, and safe by a hair is proved."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from enclosed import TRACKS, problem_of, zero_controller
from instances import ALONG, everywhere, grown, least_simulated, question, replayed, save
from whole_runs import random_controller, shifted, simulated

from harness.records import WitnessOutcome
from harness.replay import check_witness
from racecar.controller import Controller, Layer, load_controller
from racecar.instance import load_instance
from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.safety import Property, named_property
from verifier import divide, pieces
from verifier import verify as under_test
from verifier.divide import Divider
from verifier.piece import Outcome, Piece, merged
from verifier.problem import Box, Problem, load_problem
from verifier.proof import Prover
from verifier.result import Result
from verifier.verify import verify

SQUARE = TRACKS["square"]
ONNX = Path(__file__).parents[2] / "onnx"
COMMITTED = ["TD3_L21_64x64_C1", "DDPG_L21_64x64_C1"]
HAIR = 1e-4
WHOLE = Piece(0, -1.0, 1.0)


def decide(problem: Problem, timeout: float = 20.0) -> Result:
    return verify(problem, problem.controller.steering_rows, timeout)


def proved_pieces(problem: Problem, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return what the proof alone, without any search for a witness, leaves open.

    count: into how many rows the start set is divided at the beginning.
    """
    lead = int(np.argmax(problem.upper - problem.lower))
    box, edges = Box(problem.lower, problem.upper, lead), np.linspace(-1, 1, count + 1)
    result = Prover(problem, 0.0).prove(box, edges[:-1], edges[1:], 1e-6)
    return result.low, result.high


def is_open(found: tuple[np.ndarray, np.ndarray], x: float) -> bool:
    low, high = found
    return bool(((low <= x) & (x <= high)).any())


def straight(*lines: list[list[float]], steps: int = 5, **extra) -> Problem:
    """The car goes straight on, s stays what it was: every margin is known exactly."""
    safety = everywhere("lines", SQUARE, *lines)
    lower, upper = [0.65, 9.9, 0.0, 0.0], [0.85, 9.9, 0.0, 0.0]
    return question(zero_controller(21), lower, upper, safety=safety, steps=steps, **extra)


def test_a_known_margin_is_proved():
    result = decide(straight([[1.0, 0.0, 0.6]], [[-1.0, 0.0, -0.9]]))
    assert result.verdict == "unsat"
    assert 0.05 - 1e-9 < result.margin_lower <= 0.05 + 1e-15
    assert result.margin_upper == pytest.approx(0.05, abs=1e-12)
    assert result.decided == 1.0
    assert result.witness is None


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_safe_by_a_hair_is_proved_and_unsafe_by_a_hair_refuted(side):
    edge = 0.65 if side > 0 else 0.85
    safe = straight([[side, 0.0, side * edge - HAIR]])
    assert decide(safe).verdict == "unsat"
    unsafe = straight([[side, 0.0, side * edge + HAIR]])
    result = decide(unsafe)
    assert result.verdict == "sat"
    assert replayed(unsafe, result.witness) <= 0
    assert result.margin_lower is None


@pytest.mark.parametrize("where", [0.65, 0.7123456789, 0.85])
def test_the_proof_alone_never_closes_an_unsafe_sliver(where, monkeypatch):
    """Unsafe for starts within 1e-7 m of a point that no search will hit."""
    monkeypatch.setattr(divide, "NARROWEST", 1e-4)
    sliver = [[1.0, 0.0, where + 1e-7], [-1.0, 0.0, -(where - 1e-7)]]
    problem = straight(sliver)
    found = proved_pieces(problem)
    assert is_open(found, (where - 0.75) / 0.1)
    assert np.sum(found[1] - found[0]) < 0.01  # and little else


def test_the_last_instant_counts_and_the_first():
    """The front wall, reached in the last step only; a start on the edge of the unsafe set."""
    free = question(zero_controller(21), [0.7, 9.9, 2.4, 0.0], [0.8, 9.9, 2.4, 0.0], steps=20)
    end = 9.9 - 2.4 * 2.0
    for shift, verdict in ((-HAIR, "unsat"), (HAIR, "sat")):
        safety = everywhere("front", SQUARE, [[0.0, 1.0, end + shift]])
        assert decide(replace(free, safety=safety)).verdict == verdict
    touching = everywhere("touching", SQUARE, [[0.0, -1.0, -9.9]])
    assert decide(replace(free, safety=touching)).verdict == "sat"


def test_between_control_instants_counts():
    """A constant turn: the arc of one step dips towards a line that its ends keep away from."""
    steer = np.float32(-0.25)
    weights = np.zeros((1, 21), np.float32)
    turning = Controller((Layer(weights, np.array([steer]), "linear"),))
    radius = 0.45 / math.tan(abs(float(steer)))
    angle = 0.24 / radius / 2
    heading = angle  # turned back by as much at the end: s is least in the middle
    lower, upper = [0.8, 5.0, 2.4, heading], [0.8, 5.001, 2.4, heading]
    dip = 0.8 - radius * (1 - math.cos(angle))
    assert dip < 0.8 - 2e-3
    for shift, verdict in ((-HAIR, "unsat"), (HAIR, "sat")):
        safety = everywhere("left", SQUARE, [[1.0, 0.0, dip + shift]])
        problem = question(turning, lower, upper, safety=safety, steps=1)
        assert decide(problem).verdict == verdict


def corner_question(controller: Controller, name: str = "clearance", steps: int = 12) -> Problem:
    """From 3.2 m before the wall at nearly full speed into the turn, 1 mm of starts."""
    safety = named_property(name, SQUARE)
    lower, upper = [0.70, 4.2, 2.35, 0.0], [0.701, 4.2, 2.35, 0.0]
    return question(controller, lower, upper, safety=safety, steps=steps)


@pytest.mark.parametrize("name", COMMITTED)
def test_networks_made_safe_and_unsafe_by_a_hair(name):
    """The unsafe set is grown until the least margin is a hair above 0, or below."""
    problem = corner_question(load_controller(ONNX / f"{name}.onnx"))
    margin = least_simulated(problem)
    safe = replace(problem, safety=grown(problem.safety, margin - HAIR))
    result = decide(safe)
    assert result.verdict == "unsat"
    assert 0 < result.margin_lower <= least_simulated(safe) + 1e-9
    unsafe = replace(problem, safety=grown(problem.safety, margin + HAIR))
    result = decide(unsafe)
    assert result.verdict == "sat"
    assert replayed(unsafe, result.witness) <= 0


@pytest.mark.parametrize("name", COMMITTED)
def test_the_proof_alone_leaves_an_unsafe_network_open(name, monkeypatch):
    monkeypatch.setattr(divide, "NARROWEST", 0.02)
    problem = corner_question(load_controller(ONNX / f"{name}.onnx"))
    margin = least_simulated(problem)
    unsafe = replace(problem, safety=grown(problem.safety, margin + 1e-6))
    found = proved_pieces(unsafe)
    x = np.linspace(-1, 1, 201)
    s = 0.7005 + 0.0005 * x
    starts = np.stack([s, *np.tile([[4.2], [2.35], [0.0]], 201)], axis=1)
    crashed = simulated(unsafe, starts).margin <= 0
    assert crashed.any()
    assert all(is_open(found, place) for place in x[crashed])


@pytest.mark.parametrize("by", [2.0, -2.0])
def test_a_network_whose_last_bias_is_shifted_is_refuted(by, tmp_path):
    """It steers to one side all the time; the harness accepts the witness."""
    controller = shifted(load_controller(ONNX / f"{COMMITTED[0]}.onnx"), by)
    lower, upper = [0.65, 9.9, 0.0, 0.0], [0.85, 9.9, 0.0, 0.0]
    problem = question(controller, lower, upper)
    result = decide(problem)
    assert result.verdict == "sat"
    assert result.margin_upper <= 0
    assert replayed(problem, result.witness) <= 0
    path = save(problem, tmp_path)
    result.write(tmp_path / "result")
    verdict, _, witness = (tmp_path / "result").read_bytes().partition(b"\n")
    assert verdict == b"sat"
    check = check_witness(load_instance(path), path, witness)
    assert check.outcome is WitnessOutcome.CORRECT


def test_a_start_set_that_reaches_into_the_unsafe_set_is_refuted():
    lower, upper = [0.25, 9.9, 0.0, 0.0], [0.45, 9.9, 0.0, 0.0]
    problem = question(zero_controller(21), lower, upper, steps=3)
    result = decide(problem)
    assert result.verdict == "sat"
    assert lower[0] <= result.witness["s"] <= 0.3


def test_boxes_of_states():
    """All four components uncertain; the worst corner decides, and is known."""
    lower = np.array([0.70, 9.9, 2.0, -0.001])
    upper = np.array([0.72, 9.902, 2.002, 0.001])
    steps, period = 4, 0.1
    distance = steps * period * 2.4 + (2.002 - 2.4) * (1 - math.exp(-1.633 * 0.4)) / 1.633
    leftmost = 0.70 - distance * math.sin(0.001)
    for shift, verdict in ((-HAIR, "unsat"), (HAIR, "sat")):
        safety = everywhere("left", SQUARE, [[1.0, 0.0, leftmost + shift]])
        problem = problem_of(
            SQUARE, Lidar(5), zero_controller(5), steps=steps, lower=lower, upper=upper,
            safety=safety,
        )  # fmt: skip
        assert decide(problem).verdict == verdict


def into_the_next_hall(unsafe: list[list[list[list[float]]]], **extra) -> Problem:
    """Straight on at 2.4 m/s along the far end of the first hall: s passes 5, the frame changes."""
    safety = Property(
        "by frame",
        tuple(tuple(Polygon.from_constraints(p) for p in polygons) for polygons in unsafe),
    )
    lower, upper = [4.0, 0.75, 2.4, ALONG], [4.2, 0.75, 2.4, ALONG]
    return question(zero_controller(21), lower, upper, safety=safety, **extra)


NOWHERE = [[1.0, 0.0, -100.0]]


def test_unsafe_sets_that_differ_between_frames(monkeypatch):
    """Frames of one shape, but the next one's unsafe set is reached: f falls below 14."""
    monkeypatch.setattr(divide, "NARROWEST", 0.2)
    reached = [[[0.0, 1.0, 14.0]]]
    problem = into_the_next_hall([[NOWHERE], reached, [NOWHERE], [NOWHERE]], steps=9)
    assert least_simulated(problem) < 0
    assert decide(problem).verdict == "sat"
    low, high = proved_pieces(problem)
    assert merged(low, high, WHOLE)[0].tolist() == [-1.0]
    assert merged(low, high, WHOLE)[1].tolist() == [1.0]


def test_a_row_that_straddles_the_change_of_frame_is_judged_in_both(monkeypatch):
    """In the first frame s >= 5.1 is unsafe: only those who begin a step just below 5 get there."""
    monkeypatch.setattr(divide, "NARROWEST", 0.05)
    problem = into_the_next_hall([[[[-1.0, 0.0, -5.1]]], [NOWHERE], [NOWHERE], [NOWHERE]], steps=6)
    starts = np.linspace(-1, 1, 201)
    s = 4.1 + 0.1 * starts
    ends = s[:, None] + 0.24 * np.arange(7)
    unsafe = ((ends[:, :-1] <= 5.0) & (ends[:, 1:] >= 5.1 + 1e-6)).any(axis=1)
    assert 0.2 < unsafe.mean() < 0.8
    found = proved_pieces(problem)
    assert all(is_open(found, x) for x in starts[unsafe])
    clearly_safe = ~((ends[:, :-1] <= 5.0 + 0.02) & (ends[:, 1:] >= 5.1 - 0.02)).any(axis=1)
    assert not any(is_open(found, x) for x in starts[clearly_safe])
    assert decide(problem).verdict == "sat"


def test_steering_without_bound_is_never_called_safe():
    """Beyond 1 rad the arc is not enclosed; here the network steers to 1.2 rad."""
    weights = np.zeros((1, 21), np.float32)
    wild = Controller((Layer(weights, np.array([1.2], np.float32), "linear"),))
    safety = everywhere("nowhere", SQUARE, NOWHERE)
    problem = question(wild, [0.7, 9.9, 0.0, 0.0], [0.71, 9.9, 0.0, 0.0], steps=2, safety=safety)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(divide, "NARROWEST", 0.1)
        assert decide(problem).verdict == "unknown"


def test_networks_that_overflow_are_never_called_safe():
    random = np.random.default_rng(0)
    huge = (1e38 * random.normal(size=(4, 4))).astype(np.float32)
    first = (1e38 * random.normal(size=(4, 21))).astype(np.float32)
    layers = [Layer(first, np.zeros(4, np.float32), "relu")]
    layers += [Layer(huge, np.zeros(4, np.float32), "relu") for _ in range(8)]
    layers.append(Layer(huge[:1], np.zeros(1, np.float32), "tanh"))
    problem = question(
        Controller(tuple(layers)), [0.7, 9.9, 0.0, 0.0], [0.701, 9.9, 0.0, 0.0], steps=2,
        safety=everywhere("nowhere", SQUARE, NOWHERE),
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch, np.errstate(all="ignore"):
        patch.setattr(divide, "NARROWEST", 0.1)
        found = proved_pieces(problem)
    assert is_open(found, 0.0)


def test_headings_beyond_all_reason_are_left_open():
    lower, upper = [0.7, 9.9, 0.0, 5000.0], [0.71, 9.9, 0.0, 5000.0]
    problem = question(zero_controller(3), lower, upper, steps=2)
    problem = replace(problem, safety=everywhere("nowhere", SQUARE, NOWHERE))
    result = decide(problem)
    assert result.verdict == "unknown"
    assert result.decided == 0


def test_a_time_limit_gives_an_honest_unknown():
    controller = load_controller(ONNX / f"{COMMITTED[0]}.onnx")
    problem = question(controller, [0.65, 9.9, 0.0, 0.0], [0.85, 9.9, 0.0, 0.0])
    result = decide(problem, 0.001)
    assert result.verdict == "unknown"
    assert result.decided == 0.0
    assert result.margin_lower is None
    assert result.witness is None
    assert "time limit" in result.note


def outcome(piece: Piece, decided: float, in_time: bool, *rest: float) -> Outcome:
    """Return an outcome; rest: ends of the only part that stays open."""
    low, high = np.array(rest[:1]), np.array(rest[1:])
    return Outcome(piece, low, high, 0.5, 1, 0, decided, in_time, None)


@pytest.mark.parametrize(
    ("last", "verdict", "decided"),
    [
        ((1.0, True), "unsat", 1.0),
        ((1.0, False), "unknown", 1.0),  # a piece that was not treated to its end
        ((0.25, False, 0.0, 1.0), "unknown", 0.625),
        ((0.9, True, 0.9, 1.0), "unknown", 0.95),
        (None, "unknown", 0.5),  # no outcome at all
    ],
)
def test_one_piece_that_is_not_proved_leaves_the_verdict_open(monkeypatch, last, verdict, decided):
    halves = [Piece(0, -1.0, 0.0), Piece(0, 0.0, 1.0)]
    found = [outcome(halves[0], 1.0, True)]
    found += [outcome(halves[1], *last)] if last else []
    monkeypatch.setattr(under_test, "divided", lambda cases, workers: halves)
    monkeypatch.setattr(under_test, "prove_pieces", lambda *arguments: iter(found))
    result = decide(straight([[1.0, 0.0, 0.6]]))
    assert result.verdict == verdict
    assert result.decided == pytest.approx(decided)
    assert (result.margin_lower is None) == (verdict != "unsat")


def test_a_row_that_is_lost_on_the_way_counts_as_open(monkeypatch):
    """Were a row dropped by mistake, the cover of the leaves would show it."""
    original = Divider.advance

    def lose_one(self, rows, change):
        parts = original(self, rows, change)
        return parts[1:] if len(parts) > 1 else parts

    monkeypatch.setattr(Divider, "advance", lose_one)
    monkeypatch.setattr(divide, "NARROWEST", 0.01)
    monkeypatch.setattr(pieces, "TOLERANCES", (1e-6,))
    lower, upper = [4.0, 0.75, 2.4, ALONG], [4.2, 0.75, 2.4, ALONG]
    safety = everywhere("nowhere", SQUARE, NOWHERE)
    problem = question(zero_controller(21), lower, upper, safety=safety, steps=6)
    result = decide(problem)
    assert result.verdict == "unknown"
    assert result.decided < 1


def test_open_pieces_are_padded_for_the_rounding_of_their_ends(monkeypatch):
    """A failed row's exact piece lies within what is reported to be tried again."""
    monkeypatch.setattr(divide, "NARROWEST", 1e-3)
    where = 0.7123456789
    sliver = [[1.0, 0.0, where + 1e-5], [-1.0, 0.0, -(where - 1e-5)]]
    low, high = merged(*proved_pieces(straight(sliver)), WHOLE)
    edges = np.array([(where - 1e-5 - 0.75) / 0.1, (where + 1e-5 - 0.75) / 0.1])
    assert len(low) == 1
    assert low[0] < edges[0]
    assert edges[1] < high[0]


def test_merged_intervals_cover_the_given_ones_and_little_more():
    low, high = np.array([0.5, -1.0, 0.0, 0.2]), np.array([1.0, -0.5, 0.2, 0.3])
    joined = merged(low, high, WHOLE)
    assert joined[0] == pytest.approx([-1.0, 0.0, 0.5], abs=2e-10)
    assert joined[1] == pytest.approx([-0.5, 0.3, 1.0], abs=2e-10)
    assert (joined[0] <= [-1.0, 0.0, 0.5]).all()
    assert (joined[1] >= [-0.5, 0.3, 1.0]).all()
    empty = merged(np.zeros(0), np.zeros(0), WHOLE)
    assert empty[0].size == empty[1].size == 0


def test_rows_in_frames_of_one_shape_are_judged_by_their_own_unsafe_sets(monkeypatch):
    """In the next frame f >= 14.9 is unsafe: those have just come in, the others are behind."""
    monkeypatch.setattr(divide, "NARROWEST", 0.05)
    unsafe = [[NOWHERE], [[[0.0, -1.0, -14.9]]], [NOWHERE], [NOWHERE]]
    problem = into_the_next_hall(unsafe, steps=5)
    x = np.linspace(-1, 1, 201)
    ends = 4.1 + 0.1 * x[:, None] + 0.24 * np.arange(5)
    entered = ((ends > 5.0) & (ends <= 5.1 - 1e-6)).any(axis=1)
    assert 0.2 < entered.mean() < 0.8
    found = proved_pieces(problem, 8)
    assert all(is_open(found, place) for place in x[entered])


@pytest.mark.parametrize("seed", range(4))
def test_verdicts_of_small_networks_agree_with_dense_simulation(seed):
    """Random networks into the turn: whatever is said, no run contradicts it."""
    random = np.random.default_rng(seed)
    problem = corner_question(
        random_controller(random, 9, ["tanh", "relu"][seed % 2], 0.5), steps=8
    )
    result = decide(problem, 10.0)
    margin = least_simulated(problem)
    if result.verdict == "unsat":
        assert 0 < result.margin_lower <= margin + 1e-9
    if result.verdict == "sat":
        assert replayed(problem, result.witness) <= 0
    if margin < 0:
        assert result.verdict != "unsat"


FULL = "full_range/json/TD3_L21_128x128_C1.full_range.clearance.json"


def published(steps: int = 70) -> Problem:
    """Return a published instance: a TD3 controller from the whole range of starts."""
    path = Path(__file__).parents[2] / "benchmarks" / FULL
    return replace(load_problem(path)[1], steps=steps)


def test_the_whole_range_is_proved_close_to_the_least_simulated_margin():
    problem = published()
    result = decide(problem, 60.0)
    assert (result.verdict, result.decided) == ("unsat", 1.0)
    least = least_simulated(problem, 4001)
    assert least - 1e-4 <= result.margin_lower <= least
    # The unsafe set of hscc20 is a part of that of clearance.
    weaker = replace(problem, safety=named_property("hscc20", problem.plant.track))
    assert decide(weaker, 60.0).margin_lower >= result.margin_lower - 1e-6


@pytest.mark.parametrize("hair", [1e-4, -1e-4])
def test_a_wall_a_hair_beyond_or_within_reach_is_decided_rightly(hair):
    """An unsafe half-plane s >= (the largest s that simulation reaches) + hair."""
    problem = replace(published(40), safety=everywhere("far", SQUARE, NOWHERE))
    starts = problem.lower + np.linspace(0, 1, 2001)[:, None] * (problem.upper - problem.lower)
    trace = simulated(problem, starts).trace
    assert np.all(trace["frame"] == 0)
    wall = [[-1.0, 0.0, -(trace["s"].max() + hair)]]
    result = decide(replace(problem, safety=everywhere("wall", SQUARE, wall)), 60.0)
    assert result.verdict == ("unsat" if hair > 0 else "sat")


def test_states_with_several_uncertain_components_are_proved_where_small():
    problem = replace(
        published(20),
        lower=np.array([0.75, 9.9, 1.0, 0.0]),
        upper=np.array([0.751, 9.901, 1.001, 0.001]),
    )
    result = decide(problem, 60.0)
    assert result.verdict == "unsat"
    assert result.margin_lower <= result.margin_upper

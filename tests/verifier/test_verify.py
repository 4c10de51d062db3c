"""The verdicts of the reference verifier, end to end."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from racecar.closed_loop import State, simulate
from racecar.controller import Layer, RuntimeSteer
from racecar.polygon import Polygon
from racecar.safety import Property, named_property
from verifier.problem import Problem, load_problem
from verifier.verify import verify

ROOT = Path(__file__).parents[2]
FULL = ROOT / "benchmarks/full_range/json/TD3_L21_128x128_C1.full_range.clearance.json"


def the_problem(steps: int = 70) -> Problem:
    return replace(load_problem(FULL)[1], steps=steps)


def decide(problem: Problem, **options):
    return verify(problem, RuntimeSteer(problem.controller), **options)


def test_the_whole_range_is_proved_close_to_the_least_simulated_margin():
    problem = the_problem()
    result = decide(problem)
    assert (result.verdict, result.decided) == ("unsat", 1.0)
    start = State.start(np.linspace(problem.lower[0], problem.upper[0], 4001))
    runs = simulate(
        problem.plant, problem.controller.steering_rows, problem.safety, start, problem.steps
    )
    least = runs.margin.min()
    assert least - 1e-4 <= result.margin_lower <= least


def test_a_controller_with_a_shifted_bias_is_refuted_by_a_real_witness():
    problem = the_problem()
    last = problem.controller.layers[-1]
    pull = Layer(last.weights, last.biases + np.float32(0.1), last.activation)
    layers = (*problem.controller.layers[:-1], pull)
    problem = replace(problem, controller=replace(problem.controller, layers=layers))
    result = decide(problem)
    assert result.verdict == "sat"
    witness = result.witness
    start = State.start(witness["s"], witness["f"], witness["v"], witness["theta"])
    assert problem.lower[0] <= witness["s"] <= problem.upper[0]
    runs = simulate(
        problem.plant, problem.controller.steering_rows, problem.safety, start, problem.steps
    )
    assert runs.margin[0] <= 0


@pytest.mark.parametrize("hair", [1e-4, -1e-4])
def test_a_wall_a_hair_beyond_or_within_reach_is_decided_rightly(hair):
    """An unsafe half-plane s >= (the largest s that simulation reaches) + hair."""
    problem = the_problem(steps=40)
    nowhere = Property(
        "mine", tuple((Polygon.from_constraints([[1, 0, -9]]),) for _ in problem.safety.unsafe)
    )
    start = State.start(np.linspace(problem.lower[0], problem.upper[0], 2001))
    trace = simulate(
        problem.plant, problem.controller.steering_rows, nowhere, start, 40, record=True
    ).trace
    assert np.all(trace["frame"] == 0)
    wall = Polygon.from_constraints([[-1, 0, -(trace["s"].max() + hair)]])
    safety = Property("mine", tuple((wall,) for _ in problem.safety.unsafe))
    result = decide(replace(problem, safety=safety))
    assert result.verdict == ("unsat" if hair > 0 else "sat")


def test_states_with_several_uncertain_components_are_proved_where_small():
    problem = the_problem(steps=20)
    lower, upper = problem.lower.copy(), problem.upper.copy()
    lower[:] = [0.75, 9.9, 1.0, 0.0]
    upper[:] = [0.751, 9.901, 1.001, 0.001]
    result = decide(replace(problem, lower=lower, upper=upper), timeout=60)
    assert result.verdict == "unsat"
    assert result.margin_lower <= result.margin_upper


def test_a_time_limit_gives_an_honest_unknown():
    result = decide(the_problem(), timeout=1e-3)
    assert (result.verdict, result.margin_lower, result.witness) == ("unknown", None, None)
    assert result.decided < 1


def test_a_start_set_that_touches_the_unsafe_set_is_refuted():
    problem = the_problem(steps=1)
    lower = problem.lower.copy()
    lower[0] = 0.3
    result = decide(replace(problem, lower=lower))
    assert result.verdict == "sat"
    assert result.witness["s"] == 0.3


def test_hscc20_is_no_stricter_than_clearance():
    problem = the_problem()
    weaker = replace(problem, safety=named_property("hscc20", problem.plant.track))
    assert decide(weaker).margin_lower >= decide(problem).margin_lower - 1e-6


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "verifier", *arguments],
        capture_output=True, text=True, check=False, cwd=ROOT,
    )  # fmt: skip


def test_the_command_writes_the_result_file_and_json(tmp_path: Path):
    done = run("verify", str(FULL), "--result", str(tmp_path / "r.txt"), "--json")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["verdict"] == "unsat"
    fields = {"verdict", "margin_lower", "margin_upper", "decided", "leaves", "paths", "time_s"}
    assert fields | {"witness"} <= set(answer)
    assert (tmp_path / "r.txt").read_text() == "unsat\n"


@pytest.mark.parametrize("text", [None, "{", '{"format": "closedlap-instance"}'])
def test_bad_input_is_one_line_and_status_2(text, tmp_path: Path):
    file = tmp_path / "i.json"
    if text is not None:
        file.write_text(text)
    done = run("verify", str(file), "--result", str(tmp_path / "r.txt"))
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert not (tmp_path / "r.txt").exists()

"""The tools that ship: found, run, and never wrong."""

import importlib.util
import json
import math
import os
import time
from pathlib import Path

import numpy as np
import pytest
from harness_helpers import LONG, SOON, carriers, harness, straight_controller

from harness import falsifier
from harness.falsifier import Box, falsify
from harness.records import WitnessOutcome
from harness.replay import Replayer, check_witness
from harness.tool import SHIPPED, find_tool, shipped_tools
from racecar.controller import save_controller
from racecar.disturbance import Disturbance, Mirrors
from racecar.faultmodels.spec import Segment
from racecar.instance import load_instance
from racecar.witness import format_witness


def run(benchmarks, tool, tmp_path, *options):
    arguments = ("--tool", tool, "--benchmarks", benchmarks.root, "--json", *options)
    done = harness("run", *arguments, cwd=tmp_path)
    return done, {r["instance"]: r for r in map(json.loads, done.stdout.splitlines())}


def test_scripts_are_complete_and_executable():
    scripted = [name for name in shipped_tools() if find_tool(name).description is None]
    assert scripted == ["fake", "reference", "simulate"]
    for name in scripted:
        for script in ("install_tool.sh", "prepare_instance.sh", "run_instance.sh"):
            assert os.access(SHIPPED / name / script, os.X_OK)
        assert find_tool(name).version


def test_simulate_finds_what_is_obvious_and_claims_no_more(benchmarks, marker, tmp_path):
    benchmarks.add("crash_ahead", steps=LONG)
    benchmarks.add("corner", (0.25, 0.5))
    benchmarks.add("safe")
    benchmarks.add("point", (0.3, 0.3))
    benchmarks.add("near_miss", (0.30001, 0.30001))
    done, results = run(benchmarks, "simulate", tmp_path)
    assert done.returncode == 0, done.stderr
    assert {name: r["result"] for name, r in results.items()} == {
        "crash_ahead": "sat",
        "corner": "sat",
        "safe": "unknown",
        "point": "sat",
        "near_miss": "unknown",
    }
    for result in results.values():
        if result["result"] == "sat":
            assert result["witness_check"]["outcome"] == "correct"
    assert carriers(marker) == []


SIDE = 13  # a ray 34.5 degrees to the left


@pytest.mark.parametrize(
    ("kind", "witness"),
    [
        ({"noise": 0.3}, lambda w: abs(w.noise[0][SIDE]) == 0.3),
        ({"missing": 1}, lambda w: w.missing == [SIDE]),
        ({"missing": 2, "choice": "step"}, lambda w: all(SIDE in rays for rays in w.missing)),
        ({"mirrors": "wall"}, lambda w: w.mirror == 1),
        ({"missing": 1, "noise": 1e-6, "mirrors": "wall"}, lambda w: True),
    ],
    ids=["noise", "missing for the run", "missing at every step", "mirror", "all"],
)
def test_simulate_finds_disturbances(benchmarks, kind, witness):
    """One ray steers, and undisturbed the car goes straight enough for its few steps."""
    controller = straight_controller()
    # Small noise turns the car only if it is much and the wrong way that the reading counts.
    weight = -0.4 if list(kind) == ["noise"] else 0.05
    controller.layers[0].weights[0, SIDE] = weight
    # s / sin(34.5 degrees) is what it reads from the middle.
    controller.layers[0].biases[0] = -weight * 0.75 / math.sin(math.radians(34.5))
    save_controller(controller, benchmarks.onnx)
    stretches = [Segment(hall=0, begin=(0.0, a), end=(0.0, a + 3.0)) for a in (2.0, 6.0)]
    given = {"noise": 0, "missing": 0, "turn_only": False, "choice": "run"} | kind
    if "mirrors" in kind:
        given["mirrors"] = Mirrors(segments=tuple(stretches), incidence=math.radians(10))
    spec = benchmarks.add(
        "disturbed", (0.745, 0.755), steps=9, disturbance=Disturbance(**given), v=(2.4, 2.4)
    )
    instance = load_instance(spec)
    found = falsify(instance, spec, 20)
    assert found is not None
    assert witness(found)
    assert check_witness(instance, spec, format_witness(found).encode()).outcome == "correct"
    # Undisturbed there is no such start.
    box = instance.model_copy(update={"disturbance": None})
    assert falsify(box, spec, 2) is None


@pytest.mark.parametrize("seed", range(3))
def test_search_closes_in_on_a_small_corner(benchmarks, seed):
    # Unsafe is s <= 0.3: one corner of the box, a 10^-4th of its width.
    spec = benchmarks.add("corner", (0.29996, 0.7), f=(9, 10), v=(0, 1), theta=(-0.001, 0.001))
    witness = falsify(load_instance(spec), spec, 20, seed)
    assert witness.s <= 0.3
    text = format_witness(witness).encode()
    found = check_witness(load_instance(spec), spec, text)
    assert found.outcome is WitnessOutcome.CORRECT


def test_search_without_corners_needs_the_local_part(benchmarks, monkeypatch):
    monkeypatch.setattr(Box, "corners", lambda box: box.sample(4, np.random.default_rng(0)))
    spec = benchmarks.add("slice", (0.299999, 0.7))
    assert falsify(load_instance(spec), spec, 20).s <= 0.3


def test_box_never_leaves_its_bounds():
    lower, upper = np.array([0.1, 9.9, 0.0, -0.3]), np.array([0.3, 9.9, 0.0, 0.3])
    box, random = Box(lower, upper), np.random.default_rng(0)
    for starts in (
        box.corners(),
        box.sample(1000, random),
        box.near(box.corners(), np.full(5, 0.5), 1000, random),
    ):
        assert np.all((starts >= lower) & (starts <= upper))
    assert len(box.corners()) == 5
    slices = np.sort((box.sample(10, random)[:, 0] - 0.1) / 0.02)
    assert np.all(np.arange(10) <= slices + 1e-9)
    assert np.all(slices <= np.arange(1, 11) + 1e-9)


def test_sat_needs_the_strict_check(benchmarks, monkeypatch):
    spec = benchmarks.add("corner", (0.25, 0.5))
    monkeypatch.setattr(Replayer, "margin", lambda self, witness: 1e-12)
    assert falsify(load_instance(spec), spec, 5) is None


def test_simulate_respects_its_timeout(benchmarks, monkeypatch, tmp_path):
    spec = benchmarks.add("safe")
    monkeypatch.setattr(falsifier, "ROUNDS", 10**9)
    start = time.monotonic()
    assert falsify(load_instance(spec), spec, 1.5) is None
    assert 1 < time.monotonic() - start < SOON


def test_simulate_with_hardly_any_time_answers_unknown(benchmarks, tmp_path):
    spec, out = benchmarks.add("safe"), tmp_path / "result.txt"
    assert falsifier.main([str(spec), str(out), "0.01"]) == 0
    assert out.read_text() == "unknown\n"


@pytest.mark.parametrize("arguments", [[], ["a", "b"], ["a", "b", "soon"], ["none", "out", "1"]])
def test_simulate_refuses_bad_arguments(arguments, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert falsifier.main(arguments) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not Path("out").exists()


@pytest.mark.skipif(
    importlib.util.find_spec("verifier.cli") is None, reason="the verifier has no command line yet"
)
def test_reference_is_never_wrong(benchmarks, marker, tmp_path):
    benchmarks.add("crash_ahead", (0.7, 0.7), steps=LONG)
    benchmarks.add("safe", (0.7, 0.7), steps=5)
    done, results = run(benchmarks, "reference", tmp_path, "--timeout", "20")
    assert done.returncode == 0, done.stderr
    assert results["safe"]["result"] in ("unsat", "unknown")
    assert results["crash_ahead"]["result"] in ("sat", "unknown")
    for result in results.values():
        if result["result"] == "sat":
            assert result["witness_check"]["outcome"] == "correct"
    assert carriers(marker) == []

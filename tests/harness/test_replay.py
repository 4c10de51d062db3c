"""Witnesses are judged strictly; the tolerance credits and establishes nothing."""

import json
import math

import numpy as np
import pytest
from harness_helpers import LONG, SHORT, harness, straight_controller, ulps_above

from harness.answer import LARGEST_WITNESS
from harness.records import WitnessOutcome
from harness.replay import TOLERANCE, Malformed, Replayer, check_witness, parse_witness
from racecar.closed_loop import State, simulate
from racecar.controller import load_controller, save_controller
from racecar.errors import BadInput
from racecar.instance import load_instance
from racecar.witness import Witness

OUTCOME = WitnessOutcome


def witness(s, f=9.9, v=0.0, theta=0.0):
    return json.dumps({"s": s, "f": f, "v": v, "theta": theta}).encode()


def check(spec, text):
    return check_witness(load_instance(spec), spec, text)


# In [0.25, 0.5] a start with s <= 0.3 is unsafe at once; from the others a straight drive of 2 s
# keeps s, and the margin is s - 0.3.
@pytest.mark.parametrize(
    ("s", "outcome"),
    [
        (0.28, OUTCOME.CORRECT),
        (0.3, OUTCOME.CORRECT),
        (ulps_above(0.3), OUTCOME.CORRECT_WITH_TOLERANCE),
        (0.30005, OUTCOME.CORRECT_WITH_TOLERANCE),
        (0.3002, OUTCOME.WRONG),
        (0.45, OUTCOME.WRONG),
        (0.25, OUTCOME.CORRECT),
        (math.nextafter(0.25, 0), OUTCOME.CORRECT_WITH_TOLERANCE),
        (0.24995, OUTCOME.CORRECT_WITH_TOLERANCE),
        (0.2498, OUTCOME.OUT_OF_BOX),
        (-1e300, OUTCOME.OUT_OF_BOX),
        (0.50005, OUTCOME.WRONG),
    ],
)
def test_outcomes_around_the_bounds(benchmarks, s, outcome):
    spec = benchmarks.add("bounds", (0.25, 0.5))
    found = check(spec, witness(s))
    assert found.outcome is outcome
    assert found.credited == (outcome in (OUTCOME.CORRECT, OUTCOME.CORRECT_WITH_TOLERANCE))
    assert found.establishes_sat == (outcome is OUTCOME.CORRECT)
    if outcome is not OUTCOME.OUT_OF_BOX:
        assert found.margin == pytest.approx(s - 0.3, abs=1e-12)


@pytest.mark.parametrize("bound", [0.65, 0.85, 0.7, 0.123])
def test_the_tolerance_itself_is_allowed(benchmarks, bound):
    # As in VNN-COMP the bound less the tolerance is computed in doubles, and compared.
    spec = benchmarks.add("edge", (bound, bound))
    for start in (bound - TOLERANCE, bound + TOLERANCE):
        assert check(spec, witness(start)).outcome is not OUTCOME.OUT_OF_BOX
    beyond = math.nextafter(bound - TOLERANCE, 0)
    assert check(spec, witness(beyond)).outcome is OUTCOME.OUT_OF_BOX


@pytest.mark.parametrize("name", ["f", "v", "theta"])
def test_every_coordinate_counts(benchmarks, name):
    spec = benchmarks.add("point", (0.25, 0.5))
    value = {"f": 9.9}.get(name, 0.0)
    near, far = witness(0.28, **{name: value + 5e-5}), witness(0.28, **{name: value + 2e-4})
    assert check(spec, near).outcome is OUTCOME.CORRECT_WITH_TOLERANCE
    assert check(spec, far).outcome is OUTCOME.OUT_OF_BOX
    assert check(spec, far).outside == pytest.approx(2e-4)


def test_a_crash_later_is_found_between_control_instants(benchmarks):
    # Straight ahead the car hits the wall in front; the last control instant before the
    # crash is safe, so the margin must come from within a step.
    safe, unsafe = benchmarks.add("safe", steps=SHORT), benchmarks.add("unsafe", steps=LONG)
    assert check(safe, witness(0.7)).outcome is OUTCOME.WRONG
    found = check(unsafe, witness(0.7))
    assert found.outcome is OUTCOME.CORRECT
    assert found.margin <= 0


@pytest.mark.parametrize(
    "text",
    [
        b"nonsense",
        b"[0.7, 9.9, 0, 0]",
        b'{"s": 0.7, "f": 9.9, "v": 0}',
        b'{"s": 0.7, "f": 9.9, "v": 0, "theta": 0, "margin": -1}',
        b'{"s": NaN, "f": 9.9, "v": 0, "theta": 0}',
        b'{"s": Infinity, "f": 9.9, "v": 0, "theta": 0}',
        b'{"s": 1e400, "f": 9.9, "v": 0, "theta": 0}',
        b'{"s": "0.7", "f": 9.9, "v": 0, "theta": 0}',
        b'{"s": true, "f": 9.9, "v": 0, "theta": 0}',
        b'{"s": null, "f": 9.9, "v": 0, "theta": 0}',
        b'{"s": 0.7, "f": 9.9, "v": 0, "theta": 0} trailing',
        b"[" * 100_000,
        b"\xff\xfe{}",
        b'{"s": 0.7, "f": 9.9, "v": 0, "theta": 0}' + b" " * LARGEST_WITNESS,
    ],
)
def test_malformed_witnesses(benchmarks, text):
    found = check(benchmarks.add("any"), text)
    assert found.outcome is OUTCOME.MALFORMED
    assert found.message
    assert not found.credited
    with pytest.raises(Malformed):
        parse_witness(text)


@pytest.mark.parametrize("text", [b"", b" \n"])
def test_missing_witness(benchmarks, text):
    assert check(benchmarks.add("any"), text).outcome is OUTCOME.MISSING


def test_network_runs_in_float32_on_float32_scans(benchmarks):
    # A weight so large that the rounding of one reading to float32 shows in the steering.
    controller = straight_controller()
    controller.layers[0].weights[0, 10] = 1e6
    first = np.float32(5.0)
    controller.layers[0].biases[0] = -(np.float32(1e6) * first)
    save_controller(controller, benchmarks.onnx)
    spec = benchmarks.add("sensitive", (0.3, 0.9), steps=1, f=(4.0, 5.0))
    instance = load_instance(spec)
    # The middle ray reads f: 5 - 1e-8 is 5 in float32, so the car steers by exactly 0.
    start = Witness(s=0.75, f=5 - 1e-8, v=2.0, theta=0.0)
    plant, safety = instance.make_plant(), instance.make_property()
    double = load_controller(benchmarks.onnx).steering(np.full((1, 21), start.f))
    assert abs(double[0]) > 5e-3
    straight = simulate(
        plant, lambda scan: np.zeros(1), safety, State.start(0.75, start.f, 2.0), 1
    ).margin
    assert Replayer(instance, spec).margin(start) == straight[0]


def test_network_that_is_not_finite_proves_nothing(benchmarks):
    controller = straight_controller()
    controller.layers[0].weights[0, :2] = [3e38, -3e38]
    save_controller(controller, benchmarks.onnx)
    found = check(benchmarks.add("overflow", (0.65, 0.85)), witness(0.7))
    assert found.outcome is OUTCOME.WRONG
    assert found.margin is None
    assert "not finite" in found.message


def test_controller_must_be_the_one_that_the_instance_names(benchmarks):
    spec = benchmarks.add("changed")
    save_controller(straight_controller(0.1), benchmarks.onnx)
    with pytest.raises(BadInput, match="sha256"):
        check(spec, witness(0.7))


class TestCommand:
    @pytest.fixture
    def spec(self, benchmarks):
        return benchmarks.add("bounds", (0.25, 0.5))

    def replay(self, spec, tmp_path, content, *options):
        path = tmp_path / "answer"
        path.write_bytes(content)
        return harness("replay", spec, path, *options)

    def test_accepted(self, spec, tmp_path):
        done = self.replay(spec, tmp_path, b"sat\n" + witness(0.28))
        assert done.returncode == 0
        assert done.stdout.startswith("correct: least margin -0.02 m\n")

    def test_credited_but_proves_nothing(self, spec, tmp_path):
        done = self.replay(spec, tmp_path, witness(0.30005), "--json")
        assert done.returncode == 0
        found = json.loads(done.stdout)
        assert found["outcome"] == "correct_with_tolerance"
        assert found["credited"]
        assert not found["establishes_sat"]
        assert found["margin"] == pytest.approx(5e-5)

    @pytest.mark.parametrize(
        ("content", "outcome"),
        [(witness(0.4), "wrong"), (b"unsat\n", "missing"), (b"{", "malformed")],
    )
    def test_refused(self, spec, tmp_path, content, outcome):
        done = self.replay(spec, tmp_path, content, "--json")
        assert done.returncode == 1
        assert json.loads(done.stdout)["outcome"] == outcome

    def test_bad_input_is_one_line(self, spec, tmp_path):
        for arguments in ((spec, tmp_path / "none"), (tmp_path / "none", spec), (tmp_path, spec)):
            done = harness("replay", *arguments)
            assert done.returncode == 2
            assert done.stderr.startswith("error: ")
            assert done.stderr.count("\n") == 1
            assert done.stdout == ""

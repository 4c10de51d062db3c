"""Witnesses with noise and missing rays: replayed as they say, judged by what is allowed."""

import json
import math

import numpy as np
import onnxruntime
import pytest
from harness_helpers import Benchmarks, straight_controller
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.answer import LARGEST_WITNESS
from harness.records import WitnessOutcome
from harness.replay import TOLERANCE, Replayer, check_witness
from racecar.closed_loop import State
from racecar.controller import save_controller
from racecar.disturbance import Disturbance, Mirrors
from racecar.faultmodels.spec import Segment
from racecar.instance import load_instance
from racecar.witness import Witness

OUTCOME = WitnessOutcome
RAYS, MIDDLE = 21, 10
#: At top speed in front of the turn, and far from it.
TURN, HALL = {"s": 0.7, "f": 2.2, "v": 2.4}, {"s": 0.7, "f": 9.9, "v": 0.0}


def disturbance(noise=0.0, missing=0, turn_only=True, choice="run", mirrors=None):
    return Disturbance(
        noise=noise, missing=missing, turn_only=turn_only, choice=choice, mirrors=mirrors
    )


def left_wall(*stretches, degrees=45.0):
    """Stretches of the first hall's left wall, as (from, to) in metres before the corner."""
    segments = tuple(Segment(hall=0, begin=(0.0, a), end=(0.0, b)) for a, b in stretches)
    return Mirrors(segments=segments, incidence=math.radians(degrees))


def steering_controller(weights, bias=0.0):
    """A controller that is linear in the readings."""
    controller = straight_controller(bias)
    for ray, weight in weights.items():
        controller.layers[0].weights[0, ray] = weight
    return controller


@pytest.fixture
def add(benchmarks):
    """add(controller, disturbance, place, steps, ...) makes an instance around a place."""

    def make(controller, given_disturbance, place=HALL, steps=5, **box):
        save_controller(controller, benchmarks.onnx)
        sides = {name: (place[name],) * 2 for name in ("s", "f", "v")} | box
        return benchmarks.add("any", steps=steps, disturbance=given_disturbance, **sides)

    return make


def check(spec, place=HALL, **extra):
    text = json.dumps({"theta": 0.0} | place | extra).encode()
    return check_witness(load_instance(spec), spec, text)


# --- The run is the one that is given ----------------------------------------------------


def mirrored(s, f, angle, distance, stretch):
    """Tell whether a ray ends on a stretch of the left wall, 45 degrees or more off its normal."""
    if math.sin(angle) <= 0 or abs(distance - s / math.sin(angle)) > 1e-9 or distance >= 5:
        return False
    return stretch[0] <= f - distance * math.cos(angle) <= stretch[1] and abs(
        math.cos(angle)
    ) > math.sqrt(0.5)


def run_by_hand(instance, onnx, start, noise, missing, stretch=None, points=2000):
    """Drive one car with plain numbers; return the least margin seen.

    noise: ``[step][ray]``; missing: ``[step]`` sets of rays; stretch: of the left wall, mirrors.
    """
    session = onnxruntime.InferenceSession(onnx, providers=["CPUExecutionProvider"])
    plant, rules = instance.make_plant(), instance.disturbance
    s, f, v, theta = start
    frame, least = 0, math.inf
    for step in range(instance.steps):
        state = State(np.array([frame]), *(np.array([x]) for x in (s, f, v, theta)))
        scan = [float(x) for x in plant.scan_rows(state)[:, 0]]
        in_turn = 0 < s < 1.5 and f <= 2.5
        for ray, angle in enumerate(plant.lidar.angles + theta):
            gone = stretch is not None and mirrored(s, f, angle, scan[ray], stretch)
            scan[ray] = max(0.0, min(5.0, scan[ray] + noise[step][ray]))
            if gone or (ray in missing[step] and (in_turn or not rules.turn_only)):
                scan[ray] = 5.0
        ((steering,),) = session.run(None, {"scan": np.array([scan], np.float32)})[0]
        curvature = math.tan(float(steering)) / 0.45
        for i in range(points + 1):
            t = 0.1 * i / points
            # v' = -1.633 (v - 2.4), integrated.
            driven = 2.4 * t + (v - 2.4) * -math.expm1(-1.633 * t) / 1.633
            turned = curvature * driven
            chord = driven if turned == 0 else 2 * math.sin(turned / 2) / curvature
            x = s - chord * math.sin(theta + turned / 2)
            y = f - chord * math.cos(theta + turned / 2)
            least = min(least, min(x, y, max(1.5 - x, 1.5 - y)) - 0.3)
        s, f, v, theta = x, y, 2.4 + (v - 2.4) * math.exp(-0.1633), theta + turned
        if least <= 0 and min(s, f, max(1.5 - s, 1.5 - f)) <= 0.3:
            break
        if s > 5:
            frame, s, f, theta = frame + 1, f, 20 - s, theta + math.pi / 2
    return least


@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**32 - 1),
    per_step=st.booleans(),
    turn_only=st.booleans(),
    mirror=st.sampled_from([None, 0, 1]),
)
def test_the_replay_is_the_run_of_one_car_by_hand(
    tmp_path_factory, seed, per_step, turn_only, mirror
):
    random = np.random.default_rng(seed)
    benchmarks = Benchmarks(tmp_path_factory.mktemp("set"))
    weights = dict(enumerate(random.normal(size=RAYS) / 100))
    save_controller(steering_controller(weights, -sum(weights.values()) * 2.0), benchmarks.onnx)
    steps = 12
    stretches = ((0.5, 1.5), (1.0, 4.0))
    choice = "step" if per_step else "run"
    rules = disturbance(0.1, 2, turn_only, choice, left_wall(*stretches))
    spec = benchmarks.add(
        "any", steps=steps, disturbance=rules, s=(0.7, 0.7), f=(3.2, 3.2), v=(2.0, 2.0)
    )
    instance = load_instance(spec)
    noise = (0.1 * random.choice([-1.0, 0.3, 1.0], (steps, RAYS))).tolist()
    sets = [sorted(random.choice(RAYS, 2, replace=False).tolist()) for _ in range(steps)]
    missing = sets if per_step else [sets[0]] * steps
    witness = Witness(
        s=0.7, f=3.2, v=2.0, theta=0.0, missing=sets if per_step else sets[0], noise=noise,
        mirror=mirror,
    )  # fmt: skip
    stretch = None if mirror is None else stretches[mirror]
    found = Replayer(instance, spec).margin(witness)
    expected = run_by_hand(instance, benchmarks.onnx, (0.7, 3.2, 2.0, 0.0), noise, missing, stretch)
    # By hand the least is looked for at points 0.12 mm apart.
    assert expected - 1.3e-4 <= found <= expected + 1e-9


def test_noise_is_clipped_at_the_range_and_at_zero(add):
    """The middle ray reads the range: only negative noise can change it, and turns the car left."""
    spec = add(steering_controller({MIDDLE: -0.2}, 1.0), disturbance(10.0), steps=1, v=(2.0, 2.0))
    place = HALL | {"v": 2.0}
    row = [0.0] * RAYS
    margins = {}
    for noise in (0.0, 3.0, -5.0, -9.0, -1.0):
        row[MIDDLE] = noise
        margins[noise] = check(spec, place, noise=[row]).margin
    assert margins[3.0] == margins[0.0]
    assert margins[-9.0] == margins[-5.0]
    assert margins[-1.0] != margins[0.0]


def test_a_missing_ray_reads_the_range_whatever_the_noise(add):
    # The last ray looks back to the left wall; as soon as it reads 5 m the car turns left.
    spec = add(
        steering_controller({RAYS - 1: 0.3}), disturbance(0.5, 1), TURN, steps=4, theta=(0.0, 0.0)
    )
    quiet, row = check(spec, TURN, missing=[RAYS - 1]), [0.0] * RAYS
    row[RAYS - 1] = -0.5
    noisy = check(spec, TURN, missing=[RAYS - 1], noise=[row] * 4)
    assert quiet.margin == noisy.margin
    assert check(spec, TURN, noise=[row] * 4).margin != check(spec, TURN).margin


def test_missing_rays_count_only_in_the_turn_unless_everywhere(add):
    for turn_only, same in ((True, True), (False, False)):
        spec = add(
            steering_controller({RAYS - 1: 0.1}), disturbance(0, 1, turn_only), HALL | {"v": 2.4}
        )
        place = HALL | {"v": 2.4}
        alone, gone = check(spec, place), check(spec, place, missing=[RAYS - 1])
        assert (alone.margin == gone.margin) is same


def test_a_mirror_acts_after_the_noise_and_outside_the_turn(add):
    """The ray 34.5 degrees to the left meets the left wall far from the turn."""
    ray = MIDDLE + 3
    mirrors = left_wall((8.0, 9.5), (5.0, 6.0))
    spec = add(steering_controller({ray: 0.02}), disturbance(0.5, mirrors=mirrors), steps=4)
    row = [0.0] * RAYS
    row[ray] = -0.5
    quiet = check(spec, mirror=0)
    assert check(spec, mirror=0, noise=[row] * 4).margin == quiet.margin
    assert check(spec, noise=[row] * 4).margin != check(spec).margin != quiet.margin
    # No ray that counts meets the other stretch.
    assert check(spec, mirror=1).margin == check(spec).margin


# --- What is allowed ---------------------------------------------------------------------


@pytest.fixture
def unsafe(add):
    """A car that begins in the unsafe set: every allowed witness is correct."""

    def make(given_disturbance, steps=3):
        return add(straight_controller(), given_disturbance, {"s": 0.29, "f": 9.9, "v": 0.0}, steps)

    return make


UNSAFE = {"s": 0.29, "f": 9.9, "v": 0.0}


@pytest.mark.parametrize(
    ("noise", "outcome"),
    [
        (0.005, OUTCOME.CORRECT),
        (-0.005, OUTCOME.CORRECT),
        (math.nextafter(0.005, 1), OUTCOME.CORRECT_WITH_TOLERANCE),
        (-0.005 - 0.9 * TOLERANCE, OUTCOME.CORRECT_WITH_TOLERANCE),
        (0.005 + 1.1 * TOLERANCE, OUTCOME.OUT_OF_BOX),
        (-1e300, OUTCOME.OUT_OF_BOX),
    ],
)
def test_noise_around_its_bound(unsafe, noise, outcome):
    spec = unsafe(disturbance(0.005))
    rows = np.zeros((3, RAYS))
    rows[2, 7] = noise
    found = check(spec, UNSAFE, noise=rows.tolist())
    assert found.outcome is outcome
    assert found.outside == pytest.approx(max(0.0, abs(noise) - 0.005), abs=1e-18)
    assert ("noise" in found.message) == (outcome is not OUTCOME.CORRECT)


@pytest.mark.parametrize(
    ("choice", "missing", "outcome"),
    [
        ("run", [], OUTCOME.CORRECT),
        ("run", [0, 20], OUTCOME.CORRECT),
        ("run", [3, 3, 3], OUTCOME.CORRECT),
        ("run", [0, 1, 2], OUTCOME.OUT_OF_BOX),
        ("run", [21], OUTCOME.OUT_OF_BOX),
        ("run", [-1], OUTCOME.OUT_OF_BOX),
        ("run", [[0], [1], [2]], OUTCOME.MALFORMED),
        ("step", [[0, 1], [], [20]], OUTCOME.CORRECT),
        ("step", [[], [], [0, 1, 2]], OUTCOME.OUT_OF_BOX),
        ("step", [[], [], [21]], OUTCOME.OUT_OF_BOX),
        ("step", [0], OUTCOME.MALFORMED),
        ("step", [[0], [1], [2], [3]], OUTCOME.MALFORMED),
    ],
)
def test_missing_rays_that_may_and_may_not_be(unsafe, choice, missing, outcome):
    found = check(unsafe(disturbance(0, 2, choice=choice)), UNSAFE, missing=missing)
    assert found.outcome is outcome
    if outcome is OUTCOME.OUT_OF_BOX:
        assert "missing" in found.message
        assert (found.margin, found.outside) == (None, None)


@pytest.mark.parametrize(
    "shape", [(4, RAYS), (3, RAYS - 1), (3, RAYS + 1), (3, 0)], ids=lambda x: f"{x[0]}x{x[1]}"
)
def test_noise_of_another_shape_is_malformed(unsafe, shape):
    found = check(unsafe(disturbance(0.005)), UNSAFE, noise=np.zeros(shape).tolist())
    assert found.outcome is OUTCOME.MALFORMED


@pytest.mark.parametrize(
    ("mirror", "outcome", "message"),
    [
        (0, OUTCOME.CORRECT, "least margin"),
        (1, OUTCOME.CORRECT, "least margin"),
        (2, OUTCOME.OUT_OF_BOX, "the mirror 2 is not one of the segments 0 to 1"),
        (-1, OUTCOME.OUT_OF_BOX, "the mirror -1 is not one of the segments 0 to 1"),
        (0.0, OUTCOME.MALFORMED, "mirror"),
        ([0], OUTCOME.MALFORMED, "mirror"),
    ],
)
def test_a_mirror_that_may_and_may_not_be(unsafe, mirror, outcome, message):
    spec = unsafe(disturbance(mirrors=left_wall((0.0, 1.0), (1.0, 2.0))))
    found = check(spec, UNSAFE, mirror=mirror)
    assert found.outcome is outcome
    assert message in found.message


def test_an_instance_without_mirrors_takes_none(unsafe):
    found = check(unsafe(disturbance(0.005)), UNSAFE, mirror=0)
    assert found.outcome is OUTCOME.MALFORMED
    assert "no wall of the instance mirrors" in found.message


@pytest.mark.parametrize("extra", [{"missing": []}, {"noise": []}, {"missing": [1]}, {"mirror": 0}])
def test_an_undisturbed_instance_takes_four_numbers_only(unsafe, extra):
    spec = unsafe(None)
    assert check(spec, UNSAFE).outcome is OUTCOME.CORRECT
    found = check(spec, UNSAFE, **extra)
    assert found.outcome is OUTCOME.MALFORMED
    assert "no disturbance" in found.message


def test_the_start_is_judged_as_ever(unsafe):
    spec = unsafe(disturbance(0.005))
    assert check(spec, UNSAFE | {"s": 0.2}).outcome is OUTCOME.OUT_OF_BOX
    assert check(spec, UNSAFE | {"s": 0.28995}).outcome is OUTCOME.CORRECT_WITH_TOLERANCE


CLOSE = {"s": 0.7, "f": 0.6, "v": 2.4}


class TestShortLists:
    """A car straight into the wall in front: 0.3 m to go at 2.4 m/s, unsafe in the second step."""

    @pytest.fixture
    def spec(self, add):
        return add(straight_controller(), disturbance(0.005, 1, choice="step"), CLOSE, steps=9)

    @pytest.mark.parametrize("count", [2, 3, 9])
    def test_lists_may_end_where_the_car_has_been_unsafe(self, spec, count):
        rows = np.zeros((count, RAYS)).tolist()
        for extra in ({"noise": rows}, {"missing": [[]] * count}):
            found = check(spec, CLOSE, **extra)
            assert found.outcome is OUTCOME.CORRECT
            assert found.margin == check(spec, CLOSE).margin or count == 2

    @pytest.mark.parametrize("count", [0, 1])
    def test_lists_that_end_while_the_car_is_safe_are_too_short(self, spec, count):
        rows = np.zeros((count, RAYS)).tolist()
        for extra in ({"noise": rows}, {"missing": [[]] * count}):
            found = check(spec, CLOSE, **extra)
            assert found.outcome is OUTCOME.MALFORMED
            assert f"{count} of 9 steps" in found.message

    def test_the_shorter_list_counts(self, spec):
        extra = {"noise": np.zeros((9, RAYS)).tolist(), "missing": [[]]}
        assert check(spec, CLOSE, **extra).outcome is OUTCOME.MALFORMED


def test_lists_of_a_safe_run_must_reach_its_end(add):
    spec = add(straight_controller(), disturbance(0.005), steps=5)
    rows = np.zeros((5, RAYS)).tolist()
    assert check(spec, noise=rows).outcome is OUTCOME.WRONG
    assert check(spec, noise=rows[:4]).outcome is OUTCOME.MALFORMED


def test_the_noise_of_a_lap_on_the_full_scan_is_not_too_long():
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, (330, 1081))
    assert len(json.dumps(noise.tolist())) < LARGEST_WITNESS

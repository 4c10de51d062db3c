"""Fault models as data: what they do to scans, and that a run's faults are its own."""

from __future__ import annotations

import json
import math

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State
from racecar.errors import BadInput
from racecar.faultmodels.draw import spec_faults
from racecar.faultmodels.find import find_faults
from racecar.faultmodels.named import fault_names, named_faults
from racecar.faultmodels.numbers import uniforms
from racecar.faultmodels.spec import fault_schema, parse_faults
from racecar.faults import FAULTS, in_turn
from racecar.lidar import Lidar
from racecar.track import square_track

PLANT = Plant(square_track(), Bicycle(), Lidar())
RAYS, RUNS = 21, 3000


def spec(*parts):
    data = {"format": "closedlap-faults", "version": 1, "name": "x", "description": "x"}
    return parse_faults(json.dumps(data | {"parts": parts}), "x")


def missing(kind="missing", choice="run", turn_only=True, **more):
    return {"kind": kind, "choice": choice, "turn_only": turn_only} | more


def cars(s=0.75, f=1.0, runs=RUNS, theta=0.0):
    return State.start(np.full(runs, s), f, 2.0, theta)


def gone(faults, step=0, state=None):
    state = cars() if state is None else state
    return faults.missing(step, state, PLANT.scan_rows(state))


def draw(model, runs=RUNS, seed=0):
    return spec_faults(model, PLANT, np.arange(runs), seed)


# --- Numbers ---------------------------------------------------------------------------------


def test_numbers_are_uniform_and_their_neighbours_unrelated():
    table = uniforms(3, np.arange(200)[:, None, None], np.arange(50)[:, None], np.arange(40))
    assert table.shape == (200, 50, 40)
    assert stats.kstest(table.ravel(), "uniform").pvalue > 1e-3
    counts, _ = np.histogram(table, 64, (0, 1))
    assert stats.chisquare(counts).pvalue > 1e-3
    for axis in range(3):
        a, b = np.delete(table, 0, axis), np.delete(table, -1, axis)
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5 / math.sqrt(a.size)
    other = uniforms(4, np.arange(200)[:, None, None], np.arange(50)[:, None], np.arange(40))
    assert abs(np.corrcoef(table.ravel(), other.ravel())[0, 1]) < 5 / math.sqrt(table.size)


def test_numbers_are_splitmix64():
    """The first outputs of SplitMix64 from 0, as its authors' program prints them."""
    from racecar.faultmodels.numbers import _GOLDEN, _mixed

    with np.errstate(over="ignore"):
        states = np.arange(3, dtype=np.uint64) * _GOLDEN
    expected = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert _mixed(states).tolist() == expected


@pytest.mark.parametrize("name", fault_names())
@given(data=st.data())
def test_a_runs_faults_do_not_depend_on_the_runs_beside_it(name, data):
    numbers = data.draw(st.lists(st.integers(0, 10**6), min_size=2, max_size=12, unique=True))
    seed, step = data.draw(st.integers(0, 2**31)), data.draw(st.integers(0, 70))
    random = np.random.default_rng(seed)
    n = len(numbers)
    state = State.start(random.uniform(0.4, 1.1, n), random.uniform(0.5, 9, n), 2.0, 0.1)
    scan = PLANT.scan_rows(state)
    together = spec_faults(named_faults(name), PLANT, numbers, seed)(step, state, scan)
    order = data.draw(st.permutations(range(n)))
    for some in (order[: n // 2], order[n // 2 :]):
        index = np.array(some)
        alone = spec_faults(named_faults(name), PLANT, np.array(numbers)[index], seed)
        # The scan itself is given: its last bit may depend on how it is computed.
        found = alone(step, state.take(index), scan[:, index])
        assert (found == together[:, index]).all()


def test_steps_may_differ_from_run_to_run():
    model = named_faults("mixture")
    steps = np.array([3, 0, 7])
    state = cars(runs=3)
    scan = PLANT.scan_rows(state)
    together = spec_faults(model, PLANT, [0, 1, 2], 5)(steps, state, scan)
    for i, step in enumerate(steps):
        alone = spec_faults(model, PLANT, [i], 5)(
            int(step), state.take(slice(i, i + 1)), scan[:, [i]]
        )
        assert (alone[:, 0] == together[:, i]).all()


# --- Parts -----------------------------------------------------------------------------------


def test_the_papers_pattern_is_the_one_that_is_drawn_in_order():
    """The same distribution as racecar.faults draws, from other numbers."""
    counts = gone(draw(named_faults("paper_pattern"))).sum(axis=0)
    different = 20 * 19 * 18 * 17 / 21**4
    error = math.sqrt(different * (1 - different) / RUNS)
    assert abs(np.mean(counts == 5) - different) < 4 * error
    assert counts.mean() == pytest.approx(21 * (1 - (20 / 21) ** 5), abs=0.06)
    scan = np.full((RAYS, RUNS), 2.0)
    added = draw(named_faults("paper_pattern"))(0, cars(f=9.0), scan) - scan
    assert 0 <= added.min() < 1e-3
    assert 0.199 < added.max() <= 0.2
    assert stats.kstest(added.ravel()[::7] / 0.2, "uniform").pvalue > 1e-3


def test_rays_of_a_run_stay_missing_and_those_of_a_step_change():
    for choice, same in (("run", True), ("step", False)):
        faults = draw(spec(missing(rays=5, choice=choice)))
        assert (gone(faults, 0) == gone(faults, 9)).all() == same


@pytest.mark.parametrize(("f", "turn_only"), [(1.0, True), (9.0, True), (9.0, False)])
def test_rays_are_missing_in_the_turn_or_everywhere(f, turn_only):
    state = cars(f=f)
    found = gone(draw(spec(missing(rays=2, turn_only=turn_only))), state=state)
    assert found.any(axis=0).all() == (bool(in_turn(state, 1.5).all()) or not turn_only)


def test_blocks_are_neighbours_anywhere():
    found = gone(draw(spec(missing("block", rays=4))))
    assert (found.sum(axis=0) == 4).all()
    assert (np.abs(np.diff(found.astype(int), axis=0)).sum(axis=0) <= 2).all()
    first = found.argmax(axis=0)
    assert stats.chisquare(np.bincount(first, minlength=18)).pvalue > 1e-3
    assert first.max() == 17
    assert gone(draw(spec(missing("block", rays=40)))).all()


@pytest.mark.parametrize("choice", ["run", "step"])
def test_dropouts_are_as_frequent_as_said_and_independent(choice):
    found = gone(draw(spec(missing("dropout", choice=choice, probability=0.1))))
    assert found.mean() == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / found.size))
    pairs = (found[:-1] & found[1:]).mean()
    assert pairs == pytest.approx(0.01, abs=4 * math.sqrt(0.01 / found.size))


def test_measured_noise_has_the_measured_median_and_percentile():
    faults = draw(spec({"kind": "measured", "median": 0.012, "percentile95": 0.058}))
    scan = np.full((RAYS, RUNS), 2.5)
    error = faults(0, cars(), scan) - scan
    size = np.abs(error)
    assert np.median(size) == pytest.approx(0.012, rel=0.02)
    assert np.quantile(size, 0.95) == pytest.approx(0.058, rel=0.04)
    assert np.mean(error > 0) == pytest.approx(0.5, abs=0.01)
    assert abs(np.corrcoef(error[0], error[1])[0, 1]) < 0.08


def test_one_of_draws_a_choice_for_each_run_by_its_weight():
    nothing = {"weight": 1.0, "parts": []}
    all_gone = {"weight": 3.0, "parts": [missing("dropout", probability=1.0)]}
    found = gone(draw(spec({"kind": "one_of", "choices": [nothing, all_gone]})))
    assert (found.all(axis=0) == found.any(axis=0)).all()
    assert found.all(axis=0).mean() == pytest.approx(0.75, abs=4 * math.sqrt(0.1875 / RUNS))


def test_noise_is_clipped_to_the_range_and_missing_rays_come_last():
    faults = draw(spec({"kind": "noise", "low": -3.0, "high": 3.0}, missing(rays=3)))
    scan = PLANT.scan_rows(cars())
    found = faults(0, cars(), scan)
    assert found.min() == 0.0
    assert found.max() == 5.0
    assert (found[gone(faults)] == 5.0).all()


# --- Reflective walls ------------------------------------------------------------------------


def reflective(degrees, *segments, drawn=None):
    part = {"kind": "reflective", "incidence": math.radians(degrees), "segments": list(segments)}
    return spec(part | ({"drawn": drawn} if drawn else {}))


def test_rays_that_meet_a_mirror_at_a_shallow_angle_are_lost():
    """Against the geometry of one wall, s = 0, by hand."""
    state = cars(s=0.8, f=9.0, runs=1, theta=0.2)
    wall = {"hall": 0, "begin": [0.0, 9.2], "end": [0.0, 6.0]}
    found = gone(spec_faults(reflective(40, wall), PLANT, [0], 0), state=state)[:, 0]
    expected = []
    for angle in PLANT.lidar.angles + 0.2:
        # To the left wall; its normal points right, at 90 degrees to the heading 0.
        if math.sin(angle) <= 0.8 / 5:
            expected.append(False)
            continue
        f = 9.0 - 0.8 / math.tan(angle)
        incidence = abs(math.pi / 2 - angle)
        expected.append(6.0 <= f <= 9.2 and incidence > math.radians(40))
    assert found.tolist() == expected
    assert 0 < found.sum() < 8


def test_a_mirror_stays_where_it_is_when_the_frame_changes():
    """The front wall of the first hall is the left wall of the second."""
    front = {"hall": 0, "begin": [0.0, 0.0], "end": [6.0, 0.0]}
    left = {"hall": 1, "begin": [0.0, 20.0], "end": [0.0, 14.0]}
    before = State.start(np.array([4.9]), 0.7, 2.0, -1.4)
    after = PLANT.advance(State(before.frame, before.s + 0.2, before.f, before.v, before.theta))
    moved = State(before.frame, before.s + 0.2, before.f, before.v, before.theta)
    assert after.frame[0] == 1
    lost = [
        gone(spec_faults(reflective(30, wall), PLANT, [0], 0), state=state)[:, 0]
        for wall in (front, left)
        for state in (moved, after)
    ]
    assert lost[0].any()
    assert all((x == lost[0]).all() for x in lost)


def test_drawn_mirrors_lie_on_the_outer_walls_at_the_corner():
    from racecar.faultmodels.reflect import segment_ends

    drawn = {"count": 2, "length": 1.0, "within": 4.0}
    part = reflective(0, drawn=drawn).parts[0]
    ends = segment_ends(part, PLANT, 3, np.arange(2000, dtype=np.uint64))
    assert ends.shape == (2, 2000, 2, 2)
    # Global frame: the left wall of the first hall is y = 0, x <= 0; the front wall x = 0, y <= 0.
    x, y = ends[..., 0], ends[..., 1]
    assert ((np.abs(y) < 1e-12) | (np.abs(x) < 1e-12)).all()
    assert x.min() >= -4.5 - 1e-9
    assert y.min() >= -4.5 - 1e-9
    assert max(x.max(), y.max()) <= 1e-9
    on_left = (np.abs(y) < 1e-12).all(axis=-1)
    assert on_left.mean() == pytest.approx(0.5, abs=0.04)
    # Another two for every run.
    assert np.abs(ends[0] - ends[1]).max(axis=(1, 2)).min() > 0


# --- Files and names -------------------------------------------------------------------------


@pytest.mark.parametrize("name", fault_names())
def test_named_models_follow_the_schema_and_survive_their_own_text(name):
    model = named_faults(name)
    assert model.name == name
    jsonschema.validate(json.loads(model.to_json()), fault_schema())
    again = parse_faults(model.to_json(), "again")
    assert again == model
    assert again.sha256() == model.sha256()


@pytest.mark.parametrize(
    "part",
    [
        {"kind": "missing", "rays": 0, "choice": "run", "turn_only": True},
        {"kind": "missing", "rays": 5, "choice": "never", "turn_only": True},
        {"kind": "noise", "low": 0.2, "high": 0.1},
        {"kind": "noise", "low": 0.0},
        {"kind": "measured", "median": 0.2, "percentile95": 0.1},
        {"kind": "dropout", "probability": 1.5, "choice": "run", "turn_only": True},
        {"kind": "reflective", "incidence": 0.5},
        {"kind": "reflective", "incidence": 2.0, "segments": []},
        {"kind": "one_of", "choices": []},
        {"kind": "unheard_of"},
    ],
)
def test_wrong_models_are_refused_in_one_line(part):
    with pytest.raises(BadInput, match=r"^x: parts\.0") as error:
        spec(part)
    assert "\n" not in str(error.value)


def test_a_segment_in_a_hall_that_is_not_there_is_refused():
    wall = {"hall": 4, "begin": [0.0, 0.0], "end": [1.0, 0.0]}
    with pytest.raises(BadInput, match="hall 4"):
        gone(draw(reflective(30, wall)))


def test_faults_are_found_by_name_and_by_file(tmp_path):
    assert find_faults("paper") == FAULTS["paper"]
    assert find_faults("block") == named_faults("block")
    file = tmp_path / "mine.json"
    file.write_text(named_faults("block").to_json())
    assert find_faults(str(file)) == named_faults("block")
    for wrong in ("nothing", str(tmp_path / "none.json")):
        with pytest.raises(BadInput):
            find_faults(wrong)

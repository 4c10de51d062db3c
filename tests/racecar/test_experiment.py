from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, Runs, State
from racecar.errors import BadInput
from racecar.experiment import (
    BLOCK,
    EvenStarts,
    Experiment,
    Outcome,
    RandomStarts,
    default_field_of_view,
    run_experiment,
)
from racecar.faults import FAULTS, Faults
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.summary import summarise, wilson_interval
from racecar.track import square_track

PAPER_CONTROLLERS = Path(__file__).parents[2].parent / "shared" / "paper_controllers"


def plant(rays: int = 21) -> Plant:
    return Plant(square_track(), Bicycle(), Lidar(rays))


def experiment(starts=None, **changes) -> Experiment:
    car = plant()
    return Experiment(
        car, named_property("clearance", car.track), starts or RandomStarts(), **changes
    )


def straight(scan):
    return np.zeros(scan.shape[1])


def wall_follower(scan):
    """Steer away from the nearer side wall: the outcome depends on every reading."""
    right, left = scan[:10].mean(axis=0), scan[11:].mean(axis=0)
    return 0.26 * np.tanh(left - right)


def fields(outcome: Outcome) -> dict[str, np.ndarray]:
    runs, start = outcome.runs, outcome.start
    arrays = {"margin": runs.margin, "sampled": runs.margin_sampled, "crash": runs.crash_step}
    arrays |= {name: getattr(start, name) for name in ("frame", "s", "f", "v", "theta")}
    return arrays | {f"trace {k}": v for k, v in (runs.trace or {}).items()}


def assert_identical(a: Outcome, b: Outcome) -> None:
    for name, values in fields(a).items():
        assert values.tobytes() == fields(b)[name].tobytes(), name


def drive(seconds: float) -> float:
    """The distance driven from rest: v' = -c v + 2.4 c, in closed form."""
    c = 1.633
    return 2.4 * seconds - 2.4 / c * (1 - math.exp(-c * seconds))


class TestStarts:
    def test_even_starts_hit_both_ends_exactly_and_are_equally_spaced(self):
        random = np.random.default_rng(0)
        state = EvenStarts((0.65, 0.85)).states(np.arange(1001), 1001, random)
        assert (state.s[0], state.s[-1]) == (0.65, 0.85)
        np.testing.assert_allclose(np.diff(state.s), 0.0002, atol=1e-15)
        assert set(state.f) == {9.9}
        assert set(state.v) == set(state.theta) == {0.0}

    def test_even_starts_of_one_value_are_that_value(self):
        state = EvenStarts((0.7, 0.7)).states(np.arange(997), 997, np.random.default_rng(0))
        assert set(state.s) == {0.7}

    def test_a_single_even_start_lies_in_the_middle(self):
        state = EvenStarts((0.5, 1.0)).states(np.arange(1), 1, np.random.default_rng(0))
        assert list(state.s) == [0.75]

    def test_random_starts_fill_the_papers_ranges(self):
        state = RandomStarts().states(np.arange(5000), 5000, np.random.default_rng(0))
        assert 0.55 <= state.s.min() < 0.551
        assert 0.949 < state.s.max() <= 0.95
        assert -0.3 <= state.theta.min() < -0.299
        assert 0.299 < state.theta.max() <= 0.3
        assert abs(np.corrcoef(state.s, state.theta)[0, 1]) < 0.05
        assert set(state.f) == {10.0}

    @pytest.mark.parametrize("limits", [(0.8, 0.7), (math.nan, 0.7), (0.1, math.inf)])
    @pytest.mark.parametrize("kind", [EvenStarts, RandomStarts])
    def test_a_range_that_is_none_is_refused(self, kind, limits):
        with pytest.raises(BadInput, match="start: s from"):
            kind(s=limits)


class TestExperiment:
    @pytest.mark.parametrize("limits", [(0.0, 0.5), (-0.1, 0.5), (1.2, 1.5), (0.2, 7.0)])
    def test_starts_in_a_wall_are_refused(self, limits):
        with pytest.raises(BadInput, match="inside a wall or touches one"):
            experiment(EvenStarts(limits))

    def test_unsafe_starts_outside_the_walls_are_run(self):
        outcome = run_experiment(experiment(EvenStarts((0.1, 0.1)), runs=3), straight)
        assert not outcome.safe.any()
        np.testing.assert_allclose(outcome.runs.margin, -0.2, atol=1e-15)

    @pytest.mark.parametrize("change", [{"runs": 0}, {"steps": 0}, {"seed": -1}])
    def test_numbers_out_of_range_are_refused(self, change):
        with pytest.raises(BadInput, match=next(iter(change))):
            experiment(**change)

    def test_driving_straight_ends_at_the_front_wall_when_the_closed_form_says(self):
        steps = next(k for k in range(100) if drive(k / 10) >= 9.9 - 0.3)
        cases = {steps - 1: (1.0, 1.0), steps: (1.0, 0.0), steps + 1: (0.0, 0.0)}
        for horizon, (sampled, continuous) in cases.items():
            outcome = run_experiment(
                experiment(EvenStarts(), runs=11, steps=horizon), straight, record=True
            )
            shown = summarise(outcome)
            # A crash at the last step is not counted by the paper, but it is one.
            assert (shown.safe_fraction, shown.safe_fraction_continuous) == (sampled, continuous)
            end = 9.9 - drive(min(steps, horizon) / 10) - 0.3
            assert shown.margin_min == pytest.approx(end, abs=1e-12)
            assert shown.margin_min_sampled == pytest.approx(end, abs=1e-12)
            assert outcome.steps_driven == 11 * min(steps, horizon)

    def test_side_walls_bound_the_margin_of_a_short_straight_drive(self):
        outcome = run_experiment(experiment(EvenStarts((0.6, 1.0)), runs=5, steps=10), straight)
        np.testing.assert_allclose(outcome.runs.margin, [0.3, 0.4, 0.4, 0.3, 0.2], atol=1e-12)
        shown = summarise(outcome)
        assert shown.worst_run == 4
        assert shown.worst_start == {"s": 1.0, "f": 9.9, "v": 0.0, "theta": 0.0}


RUNS = 2 * BLOCK + 100


@pytest.fixture(scope="module")
def setup() -> Experiment:
    return experiment(faults=FAULTS["paper"], runs=RUNS, steps=25, seed=7)


@pytest.fixture(scope="module")
def outcome(setup) -> Outcome:
    return run_experiment(setup, wall_follower, record=True)


class TestReproducibility:
    def test_the_order_of_the_blocks_does_not_matter(self, setup, outcome):
        def backwards(function, blocks):
            return reversed([function(block) for block in reversed(blocks)])

        again = run_experiment(setup, wall_follower, record=True, map_blocks=backwards)
        assert_identical(outcome, again)

    def test_the_number_of_workers_does_not_matter(self, setup, outcome):
        with ThreadPoolExecutor(3) as pool:
            again = run_experiment(setup, wall_follower, record=True, map_blocks=pool.map)
        assert_identical(outcome, again)

    def test_recording_does_not_change_the_runs(self, setup, outcome):
        again = run_experiment(setup, wall_follower)
        assert again.runs.trace is None
        np.testing.assert_array_equal(again.runs.margin, outcome.runs.margin)

    def test_full_blocks_stay_as_they_are_when_more_runs_are_done(self, outcome):
        fewer = experiment(faults=FAULTS["paper"], runs=BLOCK, steps=25, seed=7)
        again = run_experiment(fewer, wall_follower, record=True)
        for name, values in fields(again).items():
            np.testing.assert_array_equal(values, fields(outcome)[name][:BLOCK], err_msg=name)

    def test_blocks_and_seeds_differ(self, outcome):
        start = outcome.start.s
        assert len(np.unique(start)) == RUNS
        other = experiment(faults=FAULTS["paper"], runs=BLOCK, steps=1, seed=8)
        assert not np.isin(run_experiment(other, straight).start.s, start).any()

    def test_faults_differ_from_run_to_run(self):
        same = RandomStarts((0.75, 0.75), theta=(0.0, 0.0))
        faulty = run_experiment(
            experiment(same, faults=Faults(noise=0.1), runs=50, steps=20), wall_follower
        )
        assert len(np.unique(faulty.runs.margin)) == 50
        plain = run_experiment(experiment(same, runs=50, steps=20), wall_follower)
        assert len(np.unique(plain.runs.margin)) == 1

    def test_progress_counts_every_run_once(self, setup):
        done: list[int] = []
        run_experiment(setup, straight, progress=done.append)
        assert done == [BLOCK, BLOCK, 100]


class TestSummary:
    def test_a_crash_at_the_last_step_is_not_counted(self):
        crash = np.array([-1, 0, 5, 9, 10])
        margin = np.array([0.1, -0.2, -0.1, -0.01, -0.3])
        runs = Runs(margin, margin, crash)
        outcome = Outcome(State.start(np.linspace(0.5, 0.9, 5)), runs, steps=10)
        assert outcome.safe.tolist() == [True, False, False, False, True]
        assert outcome.steps_driven == 10 + 0 + 5 + 9 + 10
        shown = summarise(outcome)
        assert (shown.runs, shown.safe, shown.safe_fraction) == (5, 2, 0.4)
        assert shown.safe_fraction_continuous == 0.2
        assert (shown.worst_run, shown.worst_start["s"]) == (4, 0.9)

    @pytest.mark.parametrize(("successes", "trials"), [(0, 7), (1, 3), (71, 100), (2000, 2000)])
    def test_wilson_bounds_solve_their_equation(self, successes, trials):
        z, share = 1.959963984540054, successes / trials
        low, high = wilson_interval(successes, trials)
        assert 0 <= low <= share <= high <= 1
        for p in (low, high):
            # The share lies z standard errors of p away from p; or p is the share itself.
            gap = (share - p) ** 2 - z * z * p * (1 - p) / trials
            assert gap == pytest.approx(0, abs=1e-12)

    def test_wilson_bounds_agree_with_a_published_example(self):
        # Newcombe 1998, Statistics in Medicine 17, table I: 81 of 263.
        assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)


@pytest.mark.parametrize(("rays", "degrees"), [(21, 230), (41, 230), (61, 230), (1081, 270)])
def test_default_field_of_view_is_the_papers(rays, degrees):
    assert default_field_of_view(rays) == math.radians(degrees)


def read_paper_controller(name: str):
    """Return a controller's steering, straight from its YAML file."""
    import yaml

    path = PAPER_CONTROLLERS / f"{name}.yml"
    if not path.exists():
        pytest.skip("the paper's controllers do not lie beside the repository")
    data = yaml.load(path.read_text(), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    layers = [
        (np.array(data["weights"][k], np.float32), np.array(data["offsets"][k], np.float32))
        for k in (1, 2, 3)
    ]

    def steer(scan):
        x = ((scan - 2.5) / 5).astype(np.float32)
        for weights, offsets in layers:
            x = np.tanh(weights @ x + offsets.reshape(-1, 1))
        return math.radians(15) * x[0].astype(float)

    return steer


@pytest.mark.parametrize(
    ("name", "share", "margin"),
    [
        ("DDPG_L21_64x64_C1", 0.281, 0.029),
        ("DDPG_L21_128x128_C2", 0.520, 0.059),
        ("TD3_L21_64x64_C1", 0.710, 0.049),
        ("TD3_L21_128x128_C1", 0.824, 0.034),
    ],
)
class TestPaperControllers:
    """Against the figures of an independent simulator (20,000 runs each)."""

    def test_safe_fraction_under_the_papers_faults(self, name, share, margin):
        steer, runs = read_paper_controller(name), 2000
        shown = summarise(run_experiment(experiment(faults=FAULTS["paper"], runs=runs), steer))
        error = math.sqrt(share * (1 - share) / runs)
        assert abs(shown.safe_fraction - share) < 3 * error
        low, high = shown.safe_fraction_interval
        assert low < shown.safe_fraction < high

    def test_all_safe_without_faults(self, name, share, margin):
        shown = summarise(
            run_experiment(experiment(EvenStarts(), runs=401), read_paper_controller(name))
        )
        assert shown.safe_fraction == shown.safe_fraction_continuous == 1.0
        assert shown.margin_min_sampled == pytest.approx(margin, abs=5e-4)
        assert shown.margin_min <= shown.margin_min_sampled

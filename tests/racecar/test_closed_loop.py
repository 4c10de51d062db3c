"""The closed loop: against a second simulator, and the paper's controllers."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from global_geometry import cast, lay_out, outline
from scipy.integrate import solve_ivp

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State, simulate
from racecar.controller import Controller, RuntimeSteer
from racecar.errors import BadInput
from racecar.faults import FAULTS
from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.safety import Property, named_property
from racecar.track import Track, square_track, track_from_turns

#: Least margins of the paper's controllers: at control instants, and in continuous time.
#: Two independent simulators found them (the second column as clearance plus 0.3 m).
PAPER_MARGINS = {
    "DDPG_L21_64x64_C1": (0.029, 0.02386),
    "DDPG_L21_128x128_C2": (0.059, 0.05927),
    "TD3_L21_64x64_C1": (0.049, 0.04950),
    "TD3_L21_128x128_C1": (0.034, 0.00844),
}
#: Their safe fractions under the paper's faults over 20,000 runs of an independent simulator.
PAPER_FRACTIONS = {
    "DDPG_L21_64x64_C1": 0.281,
    "DDPG_L21_128x128_C2": 0.520,
    "TD3_L21_64x64_C1": 0.710,
    "TD3_L21_128x128_C1": 0.824,
}


def follow_space(scan: np.ndarray) -> np.ndarray:
    """Steer to the side with more space; good enough for turns either way. ``[21, batch]``."""
    left, right = scan[13:18].sum(axis=0), scan[3:8].sum(axis=0)  # 34.5 to 80.5 degrees
    return math.radians(15) * np.tanh(0.4 * (left - right))


def always_safe(track: Track) -> Property:
    far = Polygon.from_constraints([[1, 0, -1e9]])
    return Property("none", tuple((far,) for _ in track.halls))


def second_simulator(
    track: Track, car: Bicycle, lidar: Lidar, s: float, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate one car on the plane with an ODE solver; no frames, no arcs, no polygons.

    Returns x, y, v, heading at the control instants, ``[steps + 1, 4]``, and the steering.
    """
    places = lay_out(track)
    segments, wheelbase = outline(places), car.front + car.rear
    angles = np.linspace(-lidar.field_of_view / 2, lidar.field_of_view / 2, lidar.rays)
    states, steerings = [np.array([*places[0].point(s, 9.9), 0.0, places[0].angle])], []
    for _ in range(steps):
        x, y, _, heading = states[-1]
        scan, _ = cast(segments, x, y, heading + angles, lidar.range)
        steering = float(follow_space(scan[:, None])[0])
        beta = math.atan(car.rear * math.tan(steering) / wheelbase) if car.slip else 0.0

        def slope(_: float, z: np.ndarray, beta: float = beta, steering: float = steering) -> list:
            v, course = z[2], z[3] + beta
            pull = car.motor * (car.throttle - car.hysteresis) - v
            turn = v * math.cos(beta) * math.tan(steering) / wheelbase
            return [v * math.cos(course), v * math.sin(course), car.acceleration * pull, turn]

        done = solve_ivp(slope, (0, 0.1), states[-1], method="DOP853", rtol=1e-12, atol=1e-13)
        states.append(done.y[:, -1])
        steerings.append(steering)
    return np.array(states), np.array(steerings)


@pytest.mark.parametrize("slip", [False, True])
@pytest.mark.parametrize("turns", [["right"], ["left"], ["right", "left", "left"]])
def test_traces_agree_with_a_second_simulator(turns, slip):
    track = track_from_turns(turns, length=12.0)
    plant, steps = Plant(track, Bicycle(slip=slip), Lidar()), 110
    runs = simulate(
        plant, follow_space, always_safe(track), State.start([0.7, 0.8]), steps, record=True
    )
    assert runs.trace is not None
    assert runs.trace["frame"].max() >= 1
    for car, s in enumerate((0.7, 0.8)):
        states, steerings = second_simulator(track, plant.bicycle, plant.lidar, s, steps)
        trace = {name: values[car] for name, values in runs.trace.items()}
        x, y, heading = track.to_global(trace["frame"], trace["s"], trace["f"], trace["theta"])
        assert np.abs(np.stack([x, y, trace["v"]], axis=1) - states[:, :3]).max() < 1e-8
        assert np.abs(np.sin(heading - states[:, 3])).max() < 1e-8
        assert np.abs(trace["steering"] - steerings).max() < 1e-8


@pytest.mark.parametrize("name", PAPER_MARGINS)
def test_the_papers_controllers_are_safe_without_faults(
    name: str, plant: Plant, paper_controller: Callable[[str], Controller]
):
    steer = RuntimeSteer(paper_controller(name))
    safety = named_property("clearance", plant.track)
    runs = simulate(plant, steer, safety, State.start(np.linspace(0.65, 0.85, 4001)), 70)
    at_instants, continuous = PAPER_MARGINS[name]
    assert (runs.crash_step == -1).all()
    assert runs.margin_sampled.min() == pytest.approx(at_instants, abs=1e-3)
    assert runs.margin.min() == pytest.approx(continuous, abs=1e-4)


@pytest.mark.parametrize("name", PAPER_FRACTIONS)
def test_the_papers_faults_give_the_papers_safe_fractions(
    name: str, plant: Plant, paper_controller: Callable[[str], Controller]
):
    """2000 runs, judged at control instants, a crash at the last step not counted."""
    runs, random = 2000, np.random.default_rng(20_260)
    start = State.start(random.uniform(0.55, 0.95, runs), 10, 0, random.uniform(-0.3, 0.3, runs))
    disturb = FAULTS["paper"].draw(21, runs, plant.track.width, plant.lidar.range, random)
    steer, safety = RuntimeSteer(paper_controller(name)), named_property("clearance", plant.track)
    crash = simulate(plant, steer, safety, start, 70, disturb).crash_step
    safe = np.mean((crash == -1) | (crash == 70))
    expected = PAPER_FRACTIONS[name]
    assert abs(safe - expected) < 3 * math.sqrt(expected * (1 - expected) / runs)


def test_a_margin_is_that_of_the_recorded_path(plant: Plant):
    """The continuous margin is at most the sampled one, and fine sampling confirms both."""
    safety = named_property("clearance", plant.track)
    start = State.start(np.linspace(0.6, 0.9, 7))
    runs = simulate(plant, follow_space, safety, start, 70, record=True)
    assert runs.trace is not None
    assert (runs.margin <= runs.margin_sampled).all()
    least, at_instants = np.full(7, np.inf), plant.margin(safety, start)
    for step in range(70):
        state = State(*(runs.trace[x][:, step] for x in ("frame", "s", "f", "v", "theta")))
        after, arc = plant.drive(state, runs.trace["steering"][:, step])
        at_instants = np.minimum(at_instants, plant.margin(safety, after))
        for share in np.linspace(0, 1, 101):
            s, f = arc.point(share * arc.distance)
            on_path = State(state.frame, s, f, state.v, state.theta)
            least = np.minimum(least, plant.margin(safety, on_path))
    assert runs.margin_sampled == pytest.approx(at_instants, abs=1e-15)
    assert (least >= runs.margin - 1e-14).all()
    assert least == pytest.approx(runs.margin, abs=1e-3)


def test_runs_do_not_depend_on_their_batch(plant: Plant):
    safety = named_property("clearance", plant.track)
    start = State.start(np.linspace(0.4, 1.1, 9), 9.9, 0, np.linspace(-0.5, 0.5, 9))
    together = simulate(plant, follow_space, safety, start, 200, record=True)
    assert together.trace is not None
    for i in range(9):
        alone = simulate(plant, follow_space, safety, start.take(slice(i, i + 1)), 200, record=True)
        assert alone.trace is not None
        assert alone.margin[0] == pytest.approx(together.margin[i], abs=1e-9)
        assert alone.margin_sampled[0] == pytest.approx(together.margin_sampled[i], abs=1e-9)
        assert alone.crash_step[0] == together.crash_step[i]
        for name, values in alone.trace.items():
            assert values[0] == pytest.approx(together.trace[name][i], abs=1e-8, nan_ok=True)


def test_blocks_change_nothing():
    class InBlocks:
        cars_at_once = 3

        def __init__(self) -> None:
            self.widths: set[int] = set()

        def __call__(self, scan: np.ndarray) -> np.ndarray:
            self.widths.add(scan.shape[1])
            return follow_space(scan)

    # Cars that reach the next halls one after the other, so that blocks cross their groups.
    plant = Plant(track_from_turns(["right", "left"], length=12.0), Bicycle(), Lidar())
    safety = always_safe(plant.track)
    start = State.start(np.linspace(0.6, 0.9, 10), np.linspace(4.0, 9.9, 10))
    steer = InBlocks()
    blocks, whole = (
        simulate(plant, x, safety, start, 60, record=True) for x in (steer, follow_space)
    )
    assert steer.widths == {1, 2, 3}
    assert blocks.trace is not None
    assert whole.trace is not None
    assert set(np.ptp(whole.trace["frame"], axis=0)) >= {0, 1}
    for name, values in whole.trace.items():
        assert blocks.trace[name] == pytest.approx(values, abs=1e-10)


def test_a_lap_of_the_square_ends_in_the_first_frame(plant: Plant):
    safety = always_safe(plant.track)
    runs = simulate(plant, follow_space, safety, State.start([0.7, 0.8]), 330, record=True)
    assert runs.trace is not None
    for frame in runs.trace["frame"]:
        changes = frame[np.flatnonzero(np.diff(frame)) + 1]
        assert list(changes[:4]) == [1, 2, 3, 0]
    assert np.abs(runs.trace["theta"][:, -1]).max() < 0.1  # along the hall, in its frame


def test_left_turns_mirror_right_turns():
    right, left = (
        Plant(track_from_turns([side, side]), Bicycle(), Lidar()) for side in ("right", "left")
    )
    s, theta = np.array([0.5, 0.7, 1.0]), np.array([0.1, -0.2, 0.05])
    one = simulate(
        right, follow_space, named_property("clearance", right.track),
        State.start(s, 9.9, 1.0, theta), 150, record=True,
    )  # fmt: skip
    other = simulate(
        left, follow_space, named_property("clearance", left.track),
        State.start(1.5 - s, 9.9, 1.0, -theta), 150, record=True,
    )  # fmt: skip
    assert one.trace is not None
    assert other.trace is not None
    assert one.margin == pytest.approx(other.margin, abs=1e-8)
    assert (one.crash_step == other.crash_step).all()
    assert one.trace["frame"].max() == 2
    assert (one.trace["frame"] == other.trace["frame"]).all()
    assert one.trace["s"] == pytest.approx(1.5 - other.trace["s"], abs=1e-8)
    assert one.trace["theta"] == pytest.approx(-other.trace["theta"], abs=1e-8)


def test_a_crash_ends_a_run_and_is_not_forgotten(plant: Plant):
    """Straight on from rest: the front wall comes within 0.3 m at a known time."""
    safety = named_property("clearance", plant.track)

    def straight(scan: np.ndarray) -> np.ndarray:
        return np.zeros(scan.shape[1])

    start = State.start([0.75, 0.75, 0.2], [2.0, 9.9, 5.0])
    runs = simulate(plant, straight, safety, start, 40, record=True)
    instants = np.arange(41) * 0.1
    driven = plant.bicycle.distance_after(0.0, instants)
    expected = int(np.flatnonzero(2.0 - driven <= 0.3)[0])
    assert list(runs.crash_step) == [expected, -1, 0]
    assert runs.margin[0] == pytest.approx(2.0 - driven[expected] - 0.3, abs=1e-12)
    assert runs.margin[2] == pytest.approx(-0.1)
    assert runs.trace is not None
    after = runs.trace["f"][0, expected:]
    assert (after == after[0]).all()
    assert np.isnan(runs.trace["steering"][0, expected:]).all()
    assert not np.isnan(runs.trace["steering"][0, :expected]).any()
    assert np.isnan(runs.trace["steering"][2]).all()


def test_once_all_have_crashed_nothing_more_is_asked(plant: Plant):
    calls = []

    def straight(scan: np.ndarray) -> np.ndarray:
        calls.append(scan.shape)
        return np.zeros(scan.shape[1])

    safety = named_property("clearance", plant.track)
    runs = simulate(plant, straight, safety, State.start(0.75, 1.0), 1000, record=True)
    assert runs.trace is not None
    assert len(calls) == runs.crash_step[0]
    assert runs.trace["s"].shape == (1, 1001)
    assert runs.trace["steering"].shape == (1, 1000)


def test_a_controller_that_answers_nan_is_never_safe(plant: Plant):
    def broken(scan: np.ndarray) -> np.ndarray:
        steering = follow_space(scan)
        steering[1] = np.nan
        return steering

    safety, start = named_property("clearance", plant.track), State.start([0.7, 0.75, 0.8])
    runs = simulate(plant, broken, safety, start, 20)
    alone = simulate(plant, follow_space, safety, start, 20)
    assert list(runs.crash_step) == [-1, 1, -1]
    assert np.isnan(runs.margin[1])
    assert runs.margin[[0, 2]] == pytest.approx(alone.margin[[0, 2]], abs=1e-12)


def test_no_steps_leave_the_start(plant: Plant):
    safety = named_property("clearance", plant.track)
    runs = simulate(plant, follow_space, safety, State.start([0.7, 0.2]), 0, record=True)
    assert runs.margin == pytest.approx([0.4, -0.1])
    assert list(runs.crash_step) == [-1, 0]
    assert runs.trace is not None
    assert runs.trace["s"].tolist() == [[0.7], [0.2]]
    assert runs.trace["steering"].shape == (2, 0)


def test_unsafe_sets_may_differ_between_frames_of_one_shape():
    """All halls of the square look alike; a set that is unsafe in the second alone still counts."""
    plant = Plant(square_track(), Bicycle(), Lidar())
    nowhere = (Polygon.from_constraints([[1, 0, -1e9]]),)
    everywhere = (Polygon.from_constraints([[1, 0, 1e9]]),)
    safety = Property("second hall", (nowhere, everywhere, nowhere, nowhere))
    start = State.start([0.75, 0.75], 9.0)
    start.frame[1] = 1
    assert (plant.margin(safety, start) > 0).tolist() == [True, False]
    runs = simulate(plant, follow_space, safety, State.start(0.75), 70, record=True)
    assert runs.trace is not None
    entered = int(np.flatnonzero(runs.trace["frame"][0] == 1)[0])
    assert runs.crash_step[0] == entered + 1  # the step is judged in the frame that it began in


def test_cars_in_different_frames_are_measured_each_in_its_own():
    track = track_from_turns(["right", "left"], length=11.0)
    plant, safety = Plant(track, Bicycle(), Lidar()), named_property("clearance", track)
    random = np.random.default_rng(0)
    state = State(
        random.integers(3, size=60),
        random.uniform(0.4, 1.1, 60),
        random.uniform(0.5, 10, 60),
        random.uniform(0, 2.4, 60),
        random.uniform(-3, 3, 60),
    )
    scan, steering = plant.scan_rows(state), random.uniform(-0.2, 0.2, 60)
    after, arc = plant.drive(state, steering)
    margins = plant.arc_margin(safety, state, arc, np.full(60, np.inf))
    moved = plant.advance(after)
    for i in range(60):
        one = state.take(slice(i, i + 1))
        assert plant.scan_rows(one)[:, 0] == pytest.approx(scan[:, i], abs=1e-12)
        end, path = plant.drive(one, steering[i : i + 1])
        alone = plant.arc_margin(safety, one, path, np.array([np.inf]))
        assert alone[0] == pytest.approx(margins[i], abs=1e-14)
        assert plant.advance(end).frame[0] == moved.frame[i]
        assert plant.advance(end).f[0] == pytest.approx(moved.f[i], abs=1e-12)


@pytest.mark.parametrize("period", [0.0, -0.1, math.nan, math.inf])
def test_a_wrong_period_is_refused(period):
    with pytest.raises(BadInput, match="control period"):
        Plant(square_track(), Bicycle(), Lidar(), period)

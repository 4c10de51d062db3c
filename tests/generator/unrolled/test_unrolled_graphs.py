import math
from decimal import Decimal, getcontext
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx.reference import ReferenceEvaluator

from generator.instances import ControllerFile, benchmark_plant
from generator.unrolled.general import general_graph
from generator.unrolled.geometry import Area, StartBox, deciding, kept_gap, step_distances
from generator.unrolled.graph import Task
from generator.unrolled.step import sinc_series
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State
from racecar.controller import Controller, Layer
from racecar.errors import BadInput
from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.safety import margin, named_property
from racecar.track import square_track, track_from_turns

CHECKOUT = Path(__file__).parents[3]
PLANT = benchmark_plant(21, math.radians(230))
CLEARANCE = named_property("clearance", PLANT.track)


@pytest.fixture(scope="module")
def learnt():
    """A controller that has learnt to drive; nothing here depends on which."""
    return ControllerFile.load(CHECKOUT / "onnx" / "TD3_L21_64x64_C1.onnx").controller


def task(controller, lower, upper, steps, plant=PLANT, safety=CLEARANCE):
    box = StartBox(np.array(lower, dtype=float), np.array(upper, dtype=float))
    return Task(controller, plant, safety, box, steps)


def drawn(asked, count, seed=0):
    random = np.random.default_rng(seed)
    return random.uniform(asked.start.lower, asked.start.upper, size=(count, 4))


def simulated(asked, starts):
    """Margins after each step, NaN after the first that is not positive; frames do advance."""
    plant, state, margins = asked.plant, State.start(*starts.T), []
    going = plant.margin(asked.safety, state) > 0
    for _ in range(asked.steps):
        steering = asked.controller.steering_rows(plant.scan_rows(state))
        after, _ = plant.drive(state, steering)
        now = plant.margin(asked.safety, after)
        margins.append(np.where(going, now, np.nan))
        going &= now > 0
        state = plant.advance(after)
    return np.array(margins).T


def run(model, starts):
    """Evaluate in onnxruntime, float32."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model.SerializeToString(), options)
    return session.run(None, {"start": starts.astype(np.float32)})[0]


def worst(values, margins):
    """The largest difference per start, over the steps that the simulator went."""
    return np.nanmax(np.abs(np.where(np.isnan(margins), np.nan, values - margins)), axis=1)


NEAR_TURN = ([0.35, 0.35, 0.0, -2.0], [1.15, 7.0, 2.4, 1.0])
WIDE = ([0.35, 0.35, 2.0, -3.0], [8.0, 8.0, 2.4, 3.0])
RANGE = ([0.65, 9.9, 0.0, 0.0], [0.85, 9.9, 0.0, 0.0])


@pytest.mark.parametrize(("box", "steps"), [(NEAR_TURN, 1), (WIDE, 1), (WIDE, 3), (NEAR_TURN, 5)])
def test_on_all_sides_of_the_corner_a_thousand_starts_give_the_simulators_margins(
    learnt, box, steps
):
    asked = task(learnt, *box, steps)
    starts = drawn(asked, 6000).astype(np.float32).astype(float)
    starts = starts[PLANT.margin(CLEARANCE, State.start(*starts.T)) > 0][:1000]
    assert len(starts) == 1000
    margins = simulated(asked, starts)
    twin = ReferenceEvaluator(general_graph(asked, np.float64)).run(None, {"start": starts})[0]
    assert worst(twin, margins).max() < 1e-9
    differences = worst(run(general_graph(asked), starts), margins)
    # A ray within rounding of the corner may go to either side of it.
    assert np.sum(differences > 1e-4) <= 2
    assert np.quantile(differences, 0.95) < 1e-5


@pytest.mark.parametrize("steps", [20, 70])
def test_long_runs_agree_as_far_as_the_controller_lets_them(learnt, steps):
    box = ([0.6, 1.9, 2.39, -0.4], [0.62, 2.0, 2.4, -0.38]) if steps == 20 else RANGE
    asked = task(learnt, *box, steps)
    starts = drawn(asked, 300).astype(np.float32).astype(float)
    margins = simulated(asked, starts)
    twin = general_graph(asked, np.float64)
    values = ReferenceEvaluator(twin).run(None, {"start": starts[:100]})[0]
    moved = [
        simulated(asked, starts + shift) for shift in 1e-6 * np.vstack([np.eye(4), -np.eye(4)])
    ]
    with np.errstate(invalid="ignore"):
        # By how much the simulator itself moves when the start does, by a micrometre or so.
        sensitivity = np.nanmax([np.nanmax(np.abs(m - margins), axis=1) for m in moved], axis=0)
    assert np.all(worst(values, margins[:100]) <= np.maximum(1e-9, 1e-3 * sensitivity[:100]))
    differences = worst(run(general_graph(asked), starts), margins)
    assert np.all((differences <= 1e-4) | (sensitivity > 1e-5))
    assert np.median(differences) < 1e-4


def test_a_calm_controller_agrees_in_float32_over_the_whole_horizon(make_controller):
    asked = task(make_controller(21), [0.6, 16.0, 0.0, -0.1], [0.9, 16.5, 0.0, 0.1], 70)
    starts = drawn(asked, 1000).astype(np.float32).astype(float)
    margins = simulated(asked, starts)
    assert np.isnan(margins).any(axis=1).mean() < 1
    assert worst(run(general_graph(asked), starts), margins).max() < 1e-4


@pytest.mark.parametrize("rays", [5, 41])
def test_other_lidars_properties_and_networks(make_controller, rays):
    lidar = Lidar(rays, math.radians(270), range=3.0)
    plant = Plant(square_track(12.0, 1.25), Bicycle(throttle=14), lidar, period=0.05)
    safety = named_property("hscc20", plant.track)
    controller = make_controller(rays, seed=4)
    asked = task(controller, *NEAR_TURN, 4, plant, safety)
    starts = drawn(asked, 600)
    starts = starts[plant.margin(safety, State.start(*starts.T)) > 0]
    model = general_graph(asked, np.float64)
    values = ReferenceEvaluator(model).run(None, {"start": starts})[0]
    assert worst(values, simulated(asked, starts)).max() < 1e-9


def test_a_left_turn_and_a_dead_end_come_out_of_the_same_geometry(make_controller):
    plant = Plant(track_from_turns(["left"], length=8.0), Bicycle(), Lidar())
    safety = named_property("clearance", plant.track)
    asked = task(make_controller(21), [0.4, 0.4, 1.0, -0.5], [1.1, 4.0, 2.4, 2.0], 3, plant, safety)
    starts = drawn(asked, 600)
    starts = starts[plant.margin(safety, State.start(*starts.T)) > 0]
    values = ReferenceEvaluator(general_graph(asked, np.float64)).run(None, {"start": starts})[0]
    assert worst(values, simulated(asked, starts)).max() < 1e-9


def test_the_graph_has_nothing_but_what_tools_know_and_its_weights_once(learnt):
    model = general_graph(task(learnt, *NEAR_TURN, 10))
    operators = {node.op_type for node in model.graph.node}
    assert operators == {
        "Add", "Concat", "Cos", "Div", "Gemm", "Greater", "GreaterOrEqual", "MatMul", "Max", "Min",
        "Mul", "Sin", "Sub", "Tanh", "Where",
    }  # fmt: skip
    layers = sorted(x.name for x in model.graph.initializer if x.name.endswith(".weight"))
    assert layers == [f"layer{i}.weight" for i in range(len(learnt.layers))]
    (given,), (output,) = model.graph.input, model.graph.output
    assert [d.dim_value for d in given.type.tensor_type.shape.dim] == [0, 4]
    assert [d.dim_value for d in output.type.tensor_type.shape.dim] == [0, 10]
    onnx.checker.check_model(model, full_check=True)
    assert len(model.SerializeToString()) < 200_000


def test_the_same_task_gives_the_same_bytes(learnt):
    first, second = (general_graph(task(learnt, *NEAR_TURN, 2)) for _ in range(2))
    assert first.SerializeToString() == second.SerializeToString()


@pytest.mark.parametrize(("limit", "tolerance"), [(0.08, 1e-14), (0.5, 1e-12), (1.5, 1e-6)])
def test_the_series_of_sinc_is_as_good_as_it_says(limit, tolerance):
    getcontext().prec = 60
    series = sinc_series(limit, tolerance)
    assert series.error <= tolerance
    shorter = sinc_series(limit, series.error * 1.001)
    assert len(shorter.coefficients) == len(series.coefficients)
    for i in range(1, 41):
        x = Decimal(limit) * i / 40
        exact = sum((-1) ** k * x ** (2 * k) / math.factorial(2 * k + 1) for k in range(25))
        terms = [
            (-1) ** k * x ** (2 * k) / math.factorial(2 * k + 1)
            for k in range(len(series.coefficients))
        ]
        assert abs(sum(terms) - exact) <= Decimal(series.error)
    for k, coefficient in enumerate(series.coefficients):
        assert coefficient == pytest.approx((-1) ** k / math.factorial(2 * k + 1), rel=1e-15)


def test_distances_of_the_steps_are_the_simulators():
    car, v = Bicycle(), 0.7
    slope, shift = step_distances(car, 0.1, 30)
    for i in range(30):
        assert slope[i] * 0.7 + shift[i] == pytest.approx(
            float(car.distance_after(v, 0.1)), abs=1e-13
        )
        v = float(car.speed_after(v, 0.1))


def test_polygons_that_decide_the_margin_give_the_margin_of_all():
    random = np.random.default_rng(2)
    unsafe = [
        *CLEARANCE.unsafe[0],
        Polygon.from_constraints([[0.6, 0.8, 1.0], [0.0, -1.0, -0.2], [-1.0, 0.0, 0.5]]),
    ]
    for _ in range(50):
        corner = random.uniform(-1, 8, 2)
        area = Area(corner, corner + random.uniform(0, 3, 2))
        points = random.uniform(area.lower, area.upper, size=(200, 2)).T
        np.testing.assert_array_equal(
            margin(deciding(unsafe, area), *points), margin(unsafe, *points)
        )


def test_what_a_safe_car_keeps_from_a_wall_is_kept():
    unsafe = CLEARANCE.unsafe[0]
    area = Area(np.array([0.0, 1.5]), np.array([1.5, 6.0]))
    left, inner = np.array([1.0, 0.0]), np.array([-1.0, 0.0])
    assert kept_gap(unsafe, area, left, 0.0) == pytest.approx(0.15)
    assert kept_gap(unsafe, area, inner, -1.5) == pytest.approx(0.15)
    corner = Area(np.array([0.0, 0.0]), np.array([1.5, 1.5]))
    assert kept_gap(unsafe, corner, inner, -1.5) == 0  # the car may pass the face's line there
    points = np.random.default_rng(0).uniform(area.lower, area.upper, size=(3000, 2))
    safe = points[margin(unsafe, *points.T) > 0]
    assert (safe[:, 0] > 0.15).all()
    assert (1.5 - safe[:, 0] > 0.15).all()


def test_slip_and_unbounded_steering_are_refused(learnt):
    slipping = Plant(square_track(), Bicycle(slip=True), Lidar())
    with pytest.raises(BadInput, match="slip"):
        general_graph(task(learnt, *NEAR_TURN, 1, slipping))
    loose = Controller((Layer(np.ones((1, 21), np.float32), np.zeros(1, np.float32), "linear"),))
    with pytest.raises(BadInput, match="not bounded"):
        general_graph(task(loose, *NEAR_TURN, 1))

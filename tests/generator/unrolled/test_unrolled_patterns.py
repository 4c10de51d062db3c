import math
from pathlib import Path

import numpy as np
import pytest
from onnx.reference import ReferenceEvaluator

from generator.instances import ControllerFile, benchmark_plant
from generator.unrolled.eyes import Eyes
from generator.unrolled.general import general_graph
from generator.unrolled.geometry import Area, StartBox
from generator.unrolled.graph import Task
from generator.unrolled.patterns import (
    Side,
    View,
    connected,
    find_corner,
    find_patterns,
    heading_limit,
    met_patterns,
    splits,
    views,
)
from generator.unrolled.smooth import pattern_graph
from generator.unrolled.starts import Drive, pattern_set
from generator.unrolled.step import pose
from generator.unrolled.tape import Tape
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State
from racecar.errors import BadInput
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import track_from_turns

CHECKOUT = Path(__file__).parents[3]
PLANT = benchmark_plant(21, math.radians(230))
CLEARANCE = named_property("clearance", PLANT.track)
#: Where the poses of these tests lie: the hall before the turn, the corner and the hall after it.
LOW, HIGH = np.array([0.301, 0.301]), np.array([9.0, 9.0])


@pytest.fixture(scope="module")
def learnt():
    """A controller that has learnt to drive; nothing here depends on which."""
    return ControllerFile.load(CHECKOUT / "onnx" / "TD3_L21_64x64_C1.onnx").controller


def make_task(controller, plant, steps=1):
    safety = named_property("clearance", plant.track)
    box = StartBox(np.array([*LOW, 0.0, -4.0]), np.array([*HIGH, 2.4, 4.0]))
    return Task(controller, plant, safety, box, steps)


def evaluate(tape, output, width, poses):
    model = tape.model("pose", 3, output, width, {})
    return ReferenceEvaluator(model).run(None, {"pose": poses})[0]


def eyes_on(task, tape, area):
    s, f, theta = (
        tape.column("pose", row, name) for name, row in zip("sft", np.eye(3), strict=True)
    )
    corner = find_corner(task.plant)
    return Eyes(tape, pose(tape, s, f, theta), task, area, corner, heading_limit(task))


def area_of(view):
    """Where the guards of a view put the car, as the graphs of patterns use it."""
    everywhere = Area(LOW, HIGH)
    if view.side in {Side.FAR_BEFORE, Side.BEFORE}:
        return everywhere.within((-math.inf, 1.5), (1.5, math.inf))
    if view.side == Side.CORNER:
        return everywhere.within((-math.inf, -math.inf), (1.5, 1.5))
    return everywhere.within((1.5, -math.inf), (math.inf, 1.5))


def block_and_guard(task, view, poses):
    """The smooth inverse distance to the block, and the least guard value, of poses."""
    tape = Tape(np.float64)
    eyes = eyes_on(task, tape, area_of(view))
    block, guard = eyes.block(view), tape.fold("Min", eyes.guards(view), "guard")
    output = tape.apply("Concat", block, guard, name="both", axis=1)
    values = evaluate(tape, output, task.plant.lidar.rays + 1, poses)
    return values[:, :-1], values[:, -1]


def safe_poses(task, count, seed):
    """Poses (s, f, theta), safe ones only, of any heading; many close to the lines of the faces."""
    random = np.random.default_rng(seed)
    places = random.uniform(LOW, HIGH, size=(count, 2))
    hall = random.integers(0, 3, size=count)  # 2: anywhere
    for axis in (0, 1):
        places[hall == axis, axis] = random.uniform(0.301, 1.5, np.sum(hall == axis))
    near = random.integers(0, 3, size=count)
    places[near == 1, 0] = 1.5 + random.normal(0, 0.05, np.sum(near == 1))
    places[near == 2, 1] = 1.5 + random.normal(0, 0.05, np.sum(near == 2))
    theta = random.uniform(-math.pi, math.pi, count)
    along = random.random(count) < 0.7
    theta[along] = np.where(places[along, 0] > 1.5, -math.pi / 2, 0) + random.normal(
        0, 0.5, along.sum()
    )
    margins = task.plant.margin(task.safety, State.start(places[:, 0], places[:, 1]))
    safe = (margins > 0) & (places.min(axis=1) > 0.3)
    return np.column_stack([places, theta])[safe]


def all_views(rays):
    for side in Side:
        counts = range(rays + 1) if side in {Side.BEFORE, Side.AFTER} else (0,)
        yield from (View(side, split) for split in counts)


@pytest.mark.parametrize(("rays", "degrees"), [(21, 230), (9, 270), (6, 120), (40, 180)])
def test_where_its_guards_hold_a_view_is_right_and_in_normal_headings_one_does(
    make_controller, rays, degrees
):
    """The argument in docs/vnnlib.md, tried on poses of every kind."""
    plant = benchmark_plant(rays, math.radians(degrees))
    task = make_task(make_controller(rays), plant)
    poses = safe_poses(task, 6000, rays)
    reach = plant.lidar.range
    # The true reading of the block alone, by the simulator.
    block = find_corner(plant).block
    true = plant.lidar.scan([block], *poses.T)
    covered, used = np.zeros(len(poses), dtype=bool), set()
    for view in all_views(rays):
        inverse, guard = block_and_guard(task, view, poses)
        held = guard >= 0
        covered |= held
        if held.any():
            used.add(view.side)
            read = 1 / np.maximum(inverse[held], 1 / reach)
            np.testing.assert_allclose(read, true[held], atol=1e-9)
    assert used == set(Side)
    ahead = np.where(poses[:, 0] > 1.5, -math.pi / 2, 0)
    normal = (np.abs(poses[:, 2] - ahead) < heading_limit(task)) | (poses[:, :2] < 1.5).all(axis=1)
    assert normal.sum() > 1500
    assert covered[normal].all()


def test_a_pose_has_the_view_whose_guards_hold(make_controller):
    task = make_task(make_controller(21), PLANT)
    poses = safe_poses(task, 3000, 5)
    seen = views(PLANT, find_corner(PLANT), *poses.T)
    ahead = np.where(poses[:, 0] > 1.5, -math.pi / 2, 0)
    normal = (np.abs(poses[:, 2] - ahead) < heading_limit(task)) | (poses[:, :2] < 1.5).all(axis=1)
    for view in set(seen):
        mine = normal & np.array([other == view for other in seen])
        if mine.any():
            assert block_and_guard(task, view, poses[mine])[1].min() >= -1e-12


@pytest.mark.parametrize("seed", range(6))
def test_the_cover_value_tells_exactly_where_a_listed_view_is_right(make_controller, seed):
    task = make_task(make_controller(9), benchmark_plant(9, math.radians(230)))
    poses = safe_poses(task, 1500, seed)
    random = np.random.default_rng(seed)
    least, length = random.integers(0, 7, size=2), random.integers(1, 4, size=2)
    listed = [View(Side.BEFORE, int(least[0]) + i) for i in range(length[0])]
    listed += [View(Side.AFTER, int(least[1]) + i) for i in range(length[1])]
    listed += [View(Side.CORNER), View(Side.FAR_BEFORE), View(Side.FAR_AFTER)]
    listed = sorted(view for view in listed if random.random() < 0.8 or view.split)
    if not connected([(view,) for view in listed]):
        listed = [view for view in listed if view.side not in {Side.BEFORE, Side.AFTER}]
    tape = Tape(np.float64)
    cover = eyes_on(task, tape, Area(LOW, HIGH)).cover(listed)
    tape_value = evaluate(tape, tape.apply("Add", cover, cover, name="twice"), 1, poses)[:, 0] / 2
    held = np.any([block_and_guard(task, view, poses)[1] >= 0 for view in listed], axis=0)
    clear = np.abs(tape_value) > 1e-9
    np.testing.assert_array_equal(tape_value[clear] > 0, held[clear])


def test_the_cover_value_is_positive_where_the_car_passes_from_view_to_view(make_controller):
    task = make_task(make_controller(21), PLANT)
    f = np.linspace(1.3, 1.7, 401)  # into the corner square
    poses = np.column_stack([np.full(401, 0.8), f, np.full(401, -0.2)])
    seen = sorted(set(views(PLANT, find_corner(PLANT), *poses.T)))
    assert View(Side.CORNER) in seen
    assert len(seen) >= 2
    tape = Tape(np.float64)
    cover = eyes_on(task, tape, Area(LOW, HIGH)).cover(seen)
    values = evaluate(tape, tape.apply("Add", cover, cover, name="twice"), 1, poses)
    assert values.min() > 1e-3


@pytest.fixture(scope="module", params=[1, 10, 20])
def line(request, learnt):
    found = pattern_set(Drive(learnt, PLANT, CLEARANCE), request.param)
    if found is None:
        pytest.skip("no line of starts of this controller is safe")
    starts, patterns = found
    return Task(learnt, PLANT, CLEARANCE, starts.bounds, request.param), patterns


def starts_on(task, count):
    random = np.random.default_rng(11)
    return random.uniform(task.start.lower, task.start.upper, size=(count, 4))


def simulated(task, starts):
    state, margins = State.start(*starts.T), []
    for _ in range(task.steps):
        scan = PLANT.scan_rows(state)
        state, _ = PLANT.drive(state, task.controller.steering_rows(scan))
        margins.append(PLANT.margin(CLEARANCE, state))
    return np.array(margins).T


def test_patterns_together_cover_the_set_and_each_graph_is_right_on_its_part(line):
    task, patterns = line
    k, starts = task.steps, starts_on(line[0], 400)
    margins, met = simulated(task, starts), met_patterns(task, starts)[0]
    followed = np.zeros(len(starts), dtype=int)
    for pattern in patterns:
        model = pattern_graph(task, patterns, pattern, np.float64)
        values = ReferenceEvaluator(model).run(None, {"start": starts})[0]
        assert values.shape == (len(starts), 3 * k)
        holds = values[:, k : 2 * k].min(axis=1) >= 0
        np.testing.assert_array_equal(holds, [other == pattern for other in met])
        np.testing.assert_allclose(values[holds, :k], margins[holds], atol=1e-9)
        assert (values[holds, 2 * k :] > 0).all()
        # The running guard falls only, and where it breaks first the cover still holds.
        assert (np.diff(values[:, k : 2 * k], axis=1) <= 0).all()
        followed += holds
        for row in values[~holds]:
            first = int(np.argmax(row[k : 2 * k] < 0))
            assert row[2 * k + first] > 0  # another listed pattern goes on from here
    assert (followed == 1).all()


def test_a_pattern_that_is_not_listed_is_missed_by_the_cover_values(learnt):
    bounds = StartBox(np.array([0.65, 9.9, 0, 0]), np.array([0.85, 9.9, 0, 0]))
    task = Task(learnt, PLANT, CLEARANCE, bounds, 45)
    patterns, _ = find_patterns(task, 40)
    if len(patterns) < 2:
        pytest.skip("all starts of this controller follow one pattern")
    kept, lost = patterns[:-1], patterns[-1]
    starts = starts_on(task, 2000)
    starts = starts[[pattern == lost for pattern in met_patterns(task, starts)[0]]]
    assert len(starts)
    parting = {p: next(i for i in range(45) if p[i] != lost[i]) for p in kept}
    nearest = max(kept, key=lambda p: parting[p])
    last = parting[nearest]  # up to here some listed pattern begins as the lost one does
    if not connected(kept):
        pytest.skip("without its last pattern this controller's list has a gap")
    model = pattern_graph(task, kept, nearest, np.float64)
    values = ReferenceEvaluator(model).run(None, {"start": starts})[0]
    guards, covers = values[:, 45:90], values[:, 90:]
    assert last == 0 or (guards[:, last - 1] >= 0).all()
    assert (covers[:, last] < 0).all()


def test_pattern_graphs_have_no_comparison(line):
    task, patterns = line
    model = pattern_graph(task, patterns, patterns[0])
    operators = {node.op_type for node in model.graph.node}
    assert operators <= {
        "Add", "Concat", "Cos", "Div", "Gemm", "MatMul", "Max", "Min", "Mul", "Sin", "Sub", "Tanh",
    }  # fmt: skip


def test_general_and_pattern_graph_agree_in_onnxruntime(line):
    import onnxruntime

    task, patterns = line
    starts = starts_on(task, 100).astype(np.float32)
    values = []
    for model in (general_graph(task), pattern_graph(task, patterns, patterns[0])):
        session = onnxruntime.InferenceSession(model.SerializeToString())
        values.append(session.run(None, {"start": starts})[0])
    holds = values[1][:, task.steps : 2 * task.steps].min(axis=1) > 1e-5
    assert holds.any()
    np.testing.assert_allclose(values[0][holds], values[1][holds, : task.steps], atol=1e-4)


def test_splits_with_a_gap_are_refused():
    assert splits([View(Side.BEFORE, 3), View(Side.BEFORE, 2), View(Side.CORNER)], Side.BEFORE) == (
        2,
        3,
    )
    assert splits([View(Side.CORNER)], Side.BEFORE) is None
    gap = [View(Side.BEFORE, 1), View(Side.BEFORE, 3)]
    with pytest.raises(ValueError, match="gap"):
        splits(gap, Side.BEFORE)
    assert not connected([(view,) for view in gap])


def test_left_turns_and_corners_in_reach_of_others_are_refused(make_controller):
    left = Plant(track_from_turns(["left"]), Bicycle(), Lidar())
    with pytest.raises(BadInput, match="turns right"):
        find_corner(left)
    short = Plant(track_from_turns(["right", "right"], length=6.0), Bicycle(), Lidar())
    task = make_task(make_controller(21), short)
    with pytest.raises(BadInput, match="another corner"):
        pattern_graph(task, [(View(Side.BEFORE, 3),)], (View(Side.BEFORE, 3),))

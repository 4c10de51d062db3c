"""The automaton itself, run by the reference executor, against the simulator."""

import math

import numpy as np
import pytest

from generator.hybrid.automaton import (
    Assignment,
    Automaton,
    Constraint,
    Jump,
    Mode,
    StateVariable,
    Unsafe,
    checked,
    leave,
    with_crash_mode,
)
from generator.hybrid.executor import Executor, only_one
from generator.hybrid.expression import Call, Variable, constant
from generator.hybrid.native import native_automaton
from generator.hybrid.polynomial import polynomial_automaton
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.errors import BadInput
from racecar.faults import GivenFaults
from racecar.instance import plant_data, property_data
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import track_from_turns

FORMS = {"native": native_automaton, "polynomial": polynomial_automaton}
both = pytest.mark.parametrize("form", FORMS)


def heading(values):
    return values["theta"] if "theta" in values else math.atan2(values["st"], values["ct"])


def entries(visits):
    """Yield the values with which each scan begins, and those at the end."""
    for visit in visits:
        if visit.mode.split("_")[0] in ("scan", "done"):
            yield visit


def assert_follows(executor, simulated, start, tolerance=1e-11, **choices):
    visits = list(entries(executor.run(executor.start(**start), **choices)))
    assert len(visits) == len(simulated["s"])
    for k, visit in enumerate(visits[:-1]):
        for name in ("s", "f", "v"):
            assert visit.values[name] == pytest.approx(simulated[name][k], abs=tolerance), (k, name)
        turned = heading(visit.values) - simulated["theta"][k]
        assert math.sin(turned / 2) == pytest.approx(0, abs=tolerance), k
    return visits


@both
def test_a_run_follows_the_simulator_on_both_sides_of_a_wall_jump(
    form, make_small, trace, beside_jumps
):
    instance, controller = make_small()
    executor = Executor(FORMS[form](instance, controller))
    for f in beside_jumps:
        simulated = trace(instance, controller, 0.75, f=f)
        assert_follows(executor, simulated, {"s": 0.75, "f": f})


def test_exactly_one_jump_is_open_wherever_a_mode_ends(committed):
    # only_one raises otherwise; undisturbed runs never have a choice.
    instance, controller = committed
    executor = Executor(native_automaton(instance, controller))
    for s in (0.66, 0.84):
        assert list(executor.run(executor.start(s=s), choose=only_one))[-1].mode == "done"


def with_track(track, safety):
    """Return a change of an instance's data to another track."""

    def change(data):
        plant = Plant(track, Bicycle(slip=True), Lidar(5))
        data["plant"] = plant_data(plant).model_dump(mode="json")
        data["property"] = property_data(named_property(safety, track)).model_dump(mode="json")

    return change


@both
@pytest.mark.parametrize("safety", ["clearance", "hscc20"])
@pytest.mark.parametrize(
    ("turns", "start"),
    [
        # Through a right turn, into a hall that turns left.
        (["right", "left", "right"], {"s": 0.75, "f": 2.2, "theta": 0.0}),
        # Beyond a left turn already, so that the frame is left at once.
        (["left", "right", "left"], {"s": -1.9, "f": 0.75, "theta": math.pi / 2}),
    ],
)
def test_halls_of_several_kinds_are_followed_into_each_other(
    form, safety, turns, start, make_small, trace
):
    track = track_from_turns(turns, length=7.0)

    def change(data):
        with_track(track, safety)(data)
        data["initial_set"] |= {name: [value, value] for name, value in start.items()}

    instance, controller = make_small(change=change, speed="2", steps=30)
    automaton = FORMS[form](instance, controller)
    simulated = trace(instance, controller, **start)
    assert len(set(simulated["frame"].tolist())) > 1  # it does come to another hall
    visits = assert_follows(Executor(automaton), simulated, {}, 1e-9)
    halls = [visit.values["hall"] for visit in visits[:-1]]
    assert halls == simulated["frame"][:-1].tolist()
    drives = {u.mode for u in automaton.unsafe}
    assert drives == {m.name for m in automaton.modes if m.name.startswith("drive")}
    assert len(drives) == 4


def test_only_halls_that_a_run_can_come_to_are_built(make_small):
    track = track_from_turns(["right", "left", "right"])
    instance, controller = make_small(change=with_track(track, "clearance"), steps=1)
    names = {mode.name for mode in native_automaton(instance, controller).modes}
    assert {"drive_1", "drive_2"} <= names
    assert "drive_3" not in names


@both
def test_the_unsafe_set_is_the_property_at_any_time_of_the_drive(form, make_small):
    instance, controller = make_small(speed="2.3", heading="35", steps=8)
    automaton = FORMS[form](instance, controller)
    executor = Executor(automaton)
    plant, safety = instance.make_plant(), instance.make_property()
    crashed = 0
    for visit in executor.run(executor.start(s=0.6)):
        if visit.mode != "drive":
            continue
        for time in np.linspace(0, 0.1, 7):
            values = executor.after(visit, float(time))
            points = {x: np.array([values[x]]) for x in ("s", "f")}
            margins = [p.separation(**points)[0] for p in safety.unsafe[0]]
            inside = [
                all(row.expression and _holds(row, values) for row in u.constraints)
                for u in automaton.unsafe
            ]
            assert inside == [margin <= 0 for margin in margins]
            crashed += any(inside)
    assert crashed > 0
    assert plant.period == 0.1


def _holds(row, values):
    from generator.hybrid.executor import holds
    from generator.hybrid.expression import evaluate

    return holds(row, evaluate(row.expression, values))


@both
@pytest.mark.parametrize("choice", ["run", "step"])
@pytest.mark.parametrize("turn_only", [True, False])
def test_any_noise_and_missing_rays_of_the_set_can_be_chosen(
    form, choice, turn_only, make_small, trace
):
    def change(data):
        data["disturbance"] = {
            "noise": 0.3, "missing": 2, "turn_only": turn_only, "choice": choice,
        }  # fmt: skip

    instance, controller = make_small(change=change, front="2.8", speed="2", steps=6)
    random = np.random.default_rng(8)
    steps, rays = instance.steps, 5
    noise = random.uniform(-0.3, 0.3, size=(steps, rays, 1))
    gone = np.zeros((steps, rays, 1), dtype=bool)
    for k in range(steps):
        gone[k, random.choice(rays, 2, replace=False)] = True
    if choice == "run":
        gone[:] = gone[0]
    simulated = trace(instance, controller, 0.75, GivenFaults(1.5, 5.0, gone, turn_only, noise))
    plain = trace(instance, controller, 0.75)
    assert abs(plain["theta"][-1] - simulated["theta"][-1]) > 1e-3  # it does something

    def choose(jumps, values):
        source, index = jumps[0].source, int(values["k"])
        if source.startswith(("choose_", "disturb_")):
            missing = gone[index, int(source.split("_")[1]) - 1, 0]
            counts = [j for j in jumps if any(a.variable == "gone" for a in j.reset)]
            others = [j for j in jumps if j not in counts]
            return only_one(counts if missing and counts else others, values)
        return only_one(jumps, values)

    executor, spread = watched(FORMS[form](instance, controller), noise)
    assert_follows(executor, simulated, {"s": 0.75}, 1e-9, choose=choose, spread=spread)


def watched(automaton, noise):
    """Return an executor, and a choice of ranges that follows ``noise`` period by period."""
    seen = {}

    class Watched(Executor):
        def run(self, *args, **options):
            for visit in super().run(*args, **options):
                seen.update(visit.values)
                yield visit

    def spread(assignment):
        value = float(noise[int(seen["k"]), int(assignment.variable[1:]) - 1, 0])
        assert assignment.spread[0] <= value <= assignment.spread[1]
        return value

    return Watched(automaton), spread


@both
def test_noisy_readings_are_clipped_at_0_and_at_the_range(form, make_small, trace):
    def change(data):
        data["disturbance"] = {"noise": 1.2, "missing": 0, "turn_only": False, "choice": "run"}

    instance, controller = make_small(change=change, front="5", speed="1", steps=3)
    noise = np.zeros((3, 5, 1))
    noise[:, 0], noise[:, 2] = -1.2, 1.2  # beside and behind; ahead
    simulated = trace(instance, controller, 0.75, GivenFaults(1.5, 5.0, noise=noise))
    lidar, walls = Lidar(5), instance.make_plant().track.frames[0].obstacles
    noisy = lidar.scan(walls, *(simulated[x][:-1] for x in ("s", "f", "theta"))) + noise[..., 0]
    assert (noisy[:, 0] < 0).all()
    assert (noisy[:, 2] > 5).all()
    executor, spread = watched(FORMS[form](instance, controller), noise)
    assert_follows(executor, simulated, {"s": 0.75}, 1e-10, spread=spread)


def test_no_more_rays_can_be_missing_than_the_set_allows(make_small):
    def change(data):
        data["disturbance"] = {"noise": 0, "missing": 2, "turn_only": False, "choice": "step"}

    instance, controller = make_small(change=change, steps=3)
    executor = Executor(native_automaton(instance, controller))

    def greedy(jumps, values):
        del values
        return max(jumps, key=lambda j: any(a.variable == "gone" for a in j.reset))

    counts = [
        visit.values["gone"]
        for visit in executor.run(executor.start(), choose=greedy)
        if visit.mode == "drive"
    ]
    assert counts == [2.0, 2.0, 2.0]


def test_a_longest_run_takes_as_many_jumps_and_as_long_as_stated(make_small):
    # In the corner more faces are looked at than elsewhere, and the rest of a hall has most.
    instance, controller = make_small(steps=10)
    for form in FORMS.values():
        automaton = form(instance, controller)
        executor = Executor(automaton)
        visits = list(executor.run(executor.start(f=1.9)))
        dwell = {mode.name: mode.dwell for mode in automaton.modes}
        assert len(visits) - 1 <= automaton.longest
        assert sum(dwell[v.mode] for v in visits) == pytest.approx(automaton.duration)


def unbounded(controller):
    *layers, last = controller.layers
    return type(controller)((*layers, type(last)(last.weights * 10, last.biases, "linear")))


def test_steering_that_may_reach_90_degrees_is_refused_where_tan_is_a_flow(make_small, small):
    instance, controller = make_small(controller=unbounded(small))
    with pytest.raises(BadInput, match="not bounded below 90 degrees"):
        polynomial_automaton(instance, controller)
    native_automaton(instance, controller)  # tan has no flow here


def test_a_property_without_the_walls_is_refused(make_small):
    def change(data):
        data["property"] = {"name": "other", "unsafe": [[[[1.0, 0.0, 0.3]]]] * 4}

    with pytest.raises(BadInput, match="wall"):
        native_automaton(*make_small(change=change))


def tiny(**changes):
    x, clock = StateVariable("x", "", "1"), StateVariable("clk", "", "s")
    modes = (Mode("a", "", {"x": Variable("x"), "clk": constant(1.0)}, 1.0), Mode("b", ""))
    data = {
        "name": "tiny",
        "description": "",
        "variables": (x, clock),
        "modes": modes,
        "jumps": (leave(modes[0], "b"),),
        "initial_mode": "a",
        "initial": {"x": (1.0, 1.0), "clk": (0.0, 0.0)},
        "heading": "x",
        "unsafe": (),
        "duration": 1.0,
        "longest": 1,
    }
    return checked(Automaton(**(data | changes)))


def test_flows_are_integrated_to_rounding():
    executor = Executor(tiny())
    *_, last = executor.run(executor.start())
    assert last.mode == "b"
    assert last.values["x"] == pytest.approx(math.e, rel=4e-15)
    assert last.values["clk"] == 0.0


def test_resets_see_the_values_before_the_jump():
    swap = (Assignment("x", Variable("clk")), Assignment("clk", Variable("x")))
    over = Constraint(Variable("clk"), "==", 1.0)
    executor = Executor(tiny(jumps=(Jump("a", "b", (over,), swap),)))
    *_, last = executor.run(executor.start())
    assert last.values == pytest.approx({"x": 1.0, "clk": math.e})


@pytest.mark.parametrize(
    "jumps",
    [
        (leave(tiny().modes[0], "b", [Constraint(Variable("x"), "<", 0.0)]),),
        (leave(tiny().modes[0], "b"), leave(tiny().modes[0], "b")),
    ],
)
def test_a_run_that_has_no_jump_or_two_is_an_error(jumps):
    executor = Executor(tiny(jumps=jumps))
    with pytest.raises(ValueError, match="open in a"):
        list(executor.run(executor.start()))


def test_a_flow_that_blows_up_is_an_error():
    modes = tiny().modes
    flow = {"x": Variable("x") ** 2, "clk": constant(1.0)}  # x = 1 / (1 - t)
    executor = Executor(tiny(modes=(Mode("a", "", flow, 1.5), modes[1]), jumps=(
        leave(Mode("a", "", flow, 1.5), "b"),
    )))  # fmt: skip
    with pytest.raises(ValueError, match="no solution"):
        list(executor.run(executor.start()))


@pytest.mark.parametrize(
    "changes",
    [
        {"initial_mode": "c"},
        {"initial": {"x": (0.0, 0.0)}},
        {"variables": tiny().variables * 2},
        {"modes": (*tiny().modes, Mode("a", ""))},
        {"jumps": (leave(tiny().modes[0], "c"),)},
        {"jumps": (leave(tiny().modes[0], "b", reset=[Assignment("y", constant(0.0))]),)},
        {"modes": (Mode("a", "", {"x": Variable("y")}, 1.0), tiny().modes[1])},
        {"unsafe": (Unsafe("c", ()),)},
        {"jumps": (leave(tiny().modes[0], "b", reset=[Assignment("x", constant(0.0))] * 2),)},
    ],
)
def test_an_automaton_knows_its_names_and_resets_a_variable_once(changes):
    with pytest.raises(ValueError, match=r"know|one name|twice"):
        tiny(**changes)


def test_constraints_are_negated_and_closed():
    for relation, opposite in {"<=": ">", ">": "<=", ">=": "<", "<": ">="}.items():
        row = Constraint(Variable("x"), relation, 2.0)
        assert row.negated().relation == opposite
        assert row.closed_relation == relation[0] + "="


def test_crash_mode_says_the_unsafe_set_as_jumps(make_small):
    automaton = polynomial_automaton(*make_small())
    crashing = with_crash_mode(automaton)
    assert [u.mode for u in crashing.unsafe] == ["crash"]
    into = [jump for jump in crashing.jumps if jump.target == "crash"]
    assert [(j.source, j.guard) for j in into] == [
        (u.mode, u.constraints) for u in automaton.unsafe
    ]
    assert not [jump for jump in crashing.jumps if jump.source == "crash"]
    assert automaton.polynomial
    assert not native_automaton(*make_small()).polynomial
    assert isinstance(Call("sin", Variable("x")), Call)

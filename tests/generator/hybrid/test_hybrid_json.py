"""The native JSON form: valid, and exact step by step."""

import json
import math
from itertools import islice

import jsonschema
import numpy as np
import pytest
from hybrid_readers import read_flowstar, read_json
from hybrid_runner import Runner, periods

from generator.hybrid.flowstar import flowstar_model
from generator.hybrid.json_form import automaton_json, automaton_schema
from generator.hybrid.native import native_automaton
from generator.hybrid.polynomial import polynomial_automaton


def text(instance, controller):
    return automaton_json(native_automaton(instance, controller)).text()


def one_period(runner, values):
    """Return the values a control period later."""
    return next(islice(periods(runner.run(values, "scan")), 1, None))


def assert_steps(runner, simulated, steps, tolerance=1e-12):
    """Every simulated state leads to the next one."""
    for k in range(steps - 1):
        start = runner.middle(
            **{name: simulated[name][k] for name in ("s", "f", "v", "theta")}, k=float(k)
        )
        after = one_period(runner, start)
        for name in ("s", "f", "v", "theta"):
            assert after[name] == pytest.approx(simulated[name][k + 1], abs=tolerance), (k, name)


def test_every_step_is_exact_on_both_sides_of_a_wall_jump(make_small, trace, beside_jumps):
    instance, controller = make_small()
    runner = Runner(read_json(text(instance, controller)), tolerance=1e-13)
    for f in beside_jumps:
        assert_steps(runner, trace(instance, controller, 0.75, f=f), 70)


@pytest.mark.parametrize("s", [0.65, 0.7345, 0.85])
def test_every_step_of_a_committed_controller_is_exact(committed, trace, s):
    instance, controller = committed
    runner = Runner(read_json(text(instance, controller)), tolerance=1e-13)
    assert_steps(runner, trace(instance, controller, s), 70)


def test_a_whole_run_is_followed_as_well(committed, trace):
    instance, controller = committed
    runner = Runner(read_json(text(instance, controller)), tolerance=1e-13)
    simulated = trace(instance, controller, 0.75)
    for k, values in enumerate(periods(runner.run(runner.middle(s=0.75)))):
        assert values["s"] == pytest.approx(simulated["s"][k], abs=1e-10)
    assert k == 70


def test_the_slip_angle_is_modelled(make_small, trace):
    def slip(data):
        data["plant"]["bicycle"]["slip"] = True

    instance, controller = make_small(change=slip, heading="-10", speed="1.5", steps=20)
    runner = Runner(read_json(text(instance, controller)), tolerance=1e-13)
    simulated = trace(instance, controller, 0.7, theta=math.radians(-10))
    assert_steps(runner, simulated, 20)


def test_the_file_is_valid_and_says_the_instance(make_small):
    instance, controller = make_small()
    schema = automaton_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    data = json.loads(text(instance, controller))
    jsonschema.Draft202012Validator(schema).validate(data)
    assert data["id"] == instance.id
    boxes = {x["name"]: x["initial"] for x in data["variables"]}
    assert boxes["s"] == [0.65, 0.85]
    assert boxes["theta"] == [0.0, 0.0]
    assert data["longest_run"]["duration"] == pytest.approx(7.0)
    unsafe = [
        [[*_normal(c["expression"]), c["bound"]] for c in u["constraints"]] for u in data["unsafe"]
    ]
    assert unsafe == [[list(row) for row in polygon] for polygon in instance.property.unsafe[0]]


def _normal(expression):
    return {
        "s": (1.0, 0.0), "f": (0.0, 1.0),
        json.dumps({"negate": "s"}): (-1.0, 0.0), json.dumps({"negate": "f"}): (0.0, -1.0),
    }[expression if isinstance(expression, str) else json.dumps(expression)]  # fmt: skip


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("version",), "2.0"),
        (("modes", 0, "flow"), {"s": {"sinh": "s"}}),
        (("modes", 0, "flow"), {"s": {"add": ["s"]}}),
        (("jumps", 0, "guard"), [{"expression": "s", "relation": "!=", "bound": 0.0}]),
        (("jumps", 0, "reset"), [{"variable": "s"}]),
        (("variables", 0, "initial"), [0.0]),
    ],
)
def test_the_schema_refuses_what_is_wrong(make_small, place, value):
    data = json.loads(text(*make_small()))
    *way, last = place
    inner = data
    for key in way:
        inner = inner[key]
    inner[last] = value
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(automaton_schema()).validate(data)


def test_weights_are_printed_exactly(committed):
    instance, controller = committed
    data = json.loads(text(instance, controller))
    layer = next(j for j in data["jumps"] if j["target"] == "layer_1")
    rows = [r["value"]["tanh"]["dot"] for r in layer["reset"] if r["variable"] != "clk"]
    assert np.array_equal(
        np.array([row["weights"] for row in rows]), controller.layers[0].weights.astype(float)
    )
    assert [row["bias"] for row in rows] == controller.layers[0].biases.astype(float).tolist()


def test_at_a_boundary_exactly_one_jump_is_open(make_small):
    instance, controller = make_small()
    native = Runner(read_json(text(instance, controller)))
    closed = Runner(
        read_flowstar(flowstar_model(polynomial_automaton(instance, controller)).text())
    )
    # Between two zones; where the frame changes; a ray along the outer wall, at the range of 5 m.
    for mode, state in (
        ("scan", {"f": 6.5}),
        ("drive", {"s": 5.0, "f": 0.7, "clk": 0.1}),
        ("look_2_1", {"s": 5.0, "y": 5.0, "alpha": math.pi / 2, "num": 5.0, "den": 1.0, "sa": 1.0}),
    ):
        for runner, count in ((native, 1), (closed, 2)):
            known = {name: x for name, x in state.items() if name in runner.read.variables}
            open_ = runner.open_edges(mode, runner.middle(**known))
            assert len([edge for edge, _ in open_ if edge.target != "crash"]) == count, mode

"""Flow* models: read back by the language's grammar, and run."""

import re

import numpy as np
import pytest
from hybrid_readers import Refused, read_flowstar
from hybrid_runner import Runner, periods

from generator.hybrid.automaton import Automaton, Mode, StateVariable
from generator.hybrid.flowstar import flowstar_model
from generator.hybrid.native import native_automaton
from generator.hybrid.polynomial import polynomial_automaton
from racecar.errors import BadInput

#: Words that the lexer of Flow* 2.1.0 takes for itself, single words only.
_WORDS = """
mode init in end setting order min max interval octagon grid plot tm time modes jumps inv guard
reset start output unsafe exp sin cos log sqrt cutoff precision gnuplot matlab par uncertain step
true false visualize
"""
LEXER_WORDS = set(_WORDS.split())


def model(instance, controller):
    return flowstar_model(polynomial_automaton(instance, controller)).text()


@pytest.fixture(scope="module")
def text(make_small):
    return model(*make_small())


@pytest.fixture(scope="module")
def read(text):
    return read_flowstar(text)


def assert_follows(read, trace, s, tolerance, steps, **given):
    runner = Runner(read)
    for k, values in enumerate(periods(runner.run(runner.middle(s=s, **given)))):
        for name in ("s", "f", "v"):
            assert values[name] == pytest.approx(trace[name][k], abs=tolerance), (k, name)
        if k and k < steps:  # the heading is turned in the first mode, so it is not there at k = 0
            heading = np.arctan2(values["st"], values["ct"])
            assert heading == pytest.approx(trace["theta"][k], abs=tolerance), k
    assert k == steps


def test_a_read_model_drives_the_simulated_trace_on_both_sides_of_a_wall_jump(
    read, make_small, trace, beside_jumps
):
    instance, controller = make_small()
    ends = []
    for f in beside_jumps:
        # The last period's frame is not changed: the run is over.
        simulated = trace(instance, controller, 0.75, f=f)
        assert simulated["frame"][-1] == simulated["frame"][-2] == 1
        assert_follows(read, simulated, 0.75, 1e-6, 70, f=f)
        ends.append(simulated["f"][-1])
    assert abs(ends[1] - ends[0]) > 0.01


def test_a_model_of_a_committed_controller_drives_the_first_steps(committed, trace):
    instance, controller = committed
    short = instance.model_copy(update={"steps": 2})
    simulated = trace(short, controller, 0.7)
    assert_follows(read_flowstar(model(short, controller)), simulated, 0.7, 1e-9, 2)


def test_a_heading_and_a_slip_angle_are_followed(make_small, trace):
    def slip(data):
        data["plant"]["bicycle"]["slip"] = True

    instance, controller = make_small(change=slip, heading="20", speed="2", steps=8)
    simulated = trace(instance, controller, 0.75, theta=np.radians(20))
    read = read_flowstar(model(instance, controller))
    assert_follows(read, simulated, 0.75, 1e-7, 8)


@pytest.mark.parametrize("activation", ["relu", "sigmoid"])
def test_other_activations_are_followed(activation, small, make_small, trace):
    layers = (
        type(small.layers[0])(small.layers[0].weights, small.layers[0].biases, activation),
        *small.layers[1:],
    )
    instance, controller = make_small(controller=type(small)(layers), steps=4)
    read = read_flowstar(model(instance, controller))
    assert_follows(read, trace(instance, controller, 0.75), 0.75, 1e-8, 4)


def test_the_settings_stand_in_the_order_that_the_grammar_fixes(text):
    block = text[text.index("setting") : text.index("modes")]
    order = [
        "adaptive steps {", "time ", "remainder estimation ", "identity precondition",
        "gnuplot interval ", "fixed orders ", "cutoff ", "precision ", "output ", "max jumps ",
        "print on",
    ]  # fmt: skip
    lines = [line.strip() for line in block.splitlines()[2:] if line.strip(" {}")]
    assert len(lines) == len(order)
    for line, start in zip(lines, order, strict=True):
        assert line.startswith(start)
    assert re.search(r"adaptive steps \{ min \S+, max \S+ \}", block)


def test_time_and_jumps_suffice_for_the_longest_run(text, read):
    runner = Runner(read)
    visits = list(runner.run(runner.middle()))
    assert visits[-1][0] == "done"
    spent = sum(runner.dwell(mode) for mode, _ in visits[:-1])
    allowed = float(re.search(r"^ +time (\S+)$", text, re.M)[1])
    jumps = int(re.search(r"max jumps (\d+)", text)[1])
    assert spent + 0.5 < allowed < spent + 2
    assert len(visits) - 1 < jumps


def test_every_mode_is_listed_once_under_unsafe_and_only_crash_can_be(read):
    modes = [mode for mode, _ in read.unsafe]
    assert sorted(modes) == sorted(read.flows)
    for mode, rows in read.unsafe:
        # The clock is never negative, so this never holds; no condition at all always does.
        assert rows == ([] if mode == "crash" else [("v['clk']", "<=", -1.0)])


def test_crash_can_be_reached_from_the_drive_exactly_through_the_property(read, make_small):
    instance, _ = make_small()
    edges = [edge for edge in read.edges if edge.target == "crash"]
    assert {edge.source for edge in edges} == {"drive"}
    random = np.random.default_rng(0)
    points = random.uniform([-0.5, -0.5], [21, 21], size=(500, 2))
    unsafe = instance.make_property().unsafe[0]
    runner = Runner(read)
    for s, f in points:
        # A time inside the step: the set is checked in continuous time.
        values = runner.middle(s=s, f=f, clk=0.0371)
        open_ = any(edge.target == "crash" for edge, _ in runner.open_edges("drive", values))
        assert open_ == any(polygon.separation(s, f) <= 0 for polygon in unsafe)


def test_no_name_is_a_word_of_the_language(read):
    assert not LEXER_WORDS & (set(read.variables) | set(read.flows))


def test_a_reserved_name_is_refused():
    mode = Mode("start", "a word of Flow*")
    variables = (StateVariable("clk", "clock", "s"),)
    automaton = Automaton(
        "x", "", variables, (mode,), (), "start", {"clk": (0, 0)}, "clk", (), 1.0, 1
    )
    with pytest.raises(BadInput, match="reserves the name start"):
        flowstar_model(automaton).text()


def test_an_automaton_with_functions_is_refused(make_small):
    with pytest.raises(BadInput, match="polynomial"):
        flowstar_model(native_automaton(*make_small())).text()


@pytest.mark.parametrize(
    "wrong",
    [
        ("clk <= 0.1 }", "clk < 0.1 }"),
        ("clk <= 0.1 }", "clk <= w }"),
        ("interval aggregation\n", "\n"),
        (" inv {", " {"),
        ("1.633 * (", "1.633 / ("),
        ("poly ode 1", "poly ode"),
    ],
)
def test_the_reader_of_these_tests_is_strict(text, wrong):
    before, after = wrong
    assert before in text
    if "/" in after:
        # A polynomial has no division; the reader keeps it, so the printer must not write it.
        assert "/" not in re.sub(r"#.*", "", text)
        return
    with pytest.raises((Refused, ValueError)):
        read_flowstar(text.replace(before, after, 1))

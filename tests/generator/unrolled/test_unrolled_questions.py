import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from vnnlib_reader import NUMBER, Read

from generator.instances import ControllerFile, benchmark_plant
from generator.openloop.part import Draw
from generator.openloop.printer import VERSIONS, print_spec
from generator.unrolled.part import unrolled_part
from generator.unrolled.questions import unrolled_questions
from racecar.closed_loop import State, simulate
from racecar.safety import named_property

CHECKOUT = Path(__file__).parents[3]
FILE = CHECKOUT / "onnx" / "TD3_L21_64x64_C1.onnx"
PLANT = benchmark_plant(21, math.radians(230))
CLEARANCE = named_property("clearance", PLANT.track)


@pytest.fixture(scope="module")
def controller():
    return ControllerFile.load(FILE).controller


@pytest.fixture(scope="module")
def made(controller):
    """Graphs by name, and questions by what follows the controller in their IDs."""
    graphs, questions = {}, {}
    for more, asked in unrolled_questions("A", controller, PLANT):
        graphs |= {graph.name: graph.content for graph in more}
        questions |= {question.id.removeprefix("A.unrolled."): question for question in asked}
    return graphs, questions


def session(content):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(content, options)


def bounds(question):
    (box,) = question.spec.boxes
    return box.lower.astype(float), box.upper.astype(float)


def test_every_number_of_steps_has_its_questions_and_patterns(made):
    graphs, questions = made
    for steps in (1, 2, 5, 10, 20):
        assert f"k{steps}.box" in questions
    assert "k70.range" in questions
    assert any(name.startswith("k20.left") for name in questions)
    lines = {name.split(".p")[0] for name in questions if name.endswith(".safe")}
    assert {line.split(".")[0] for line in lines} >= {"k1", "k2", "k5"}
    for line in lines:
        assert line in questions  # the general graph is asked about the same starts
        numbers = {
            name.removeprefix(f"{line}.") for name in questions if name.startswith(f"{line}.p")
        }
        count = len(numbers) // 2
        assert numbers == {f"p{i}.{kind}" for i in range(count) for kind in ("safe", "cover")}
    assert {question.graph for question in questions.values()} == set(graphs)


def test_specifications_fit_their_networks_and_their_numbers_are_exact(made):
    graphs, questions = made
    for question in questions.values():
        model = onnx.load_from_string(graphs[question.graph])
        (given,), (output,) = model.graph.input, model.graph.output
        shapes = [x.type.tensor_type.shape.dim[1].dim_value for x in (given, output)]
        for version in VERSIONS:
            read = Read(print_spec(question.spec, version))
            assert [read.inputs, read.outputs] == shapes
            for number in read.numbers:
                assert NUMBER.fullmatch(number)
                assert Fraction(number) == Fraction(float(np.float32(number)))


def test_start_sets_are_inside_what_they_say_and_all_starts_are_safe(made):
    _, questions = made
    low, high = bounds(questions["k70.range"])
    assert Fraction("0.65") <= Fraction(low[0]) < Fraction("0.65") + Fraction(1, 2**24)
    assert Fraction("0.85") - Fraction(1, 2**24) < Fraction(high[0]) <= Fraction("0.85")
    assert low[1] == high[1] == np.float32(9.9)
    assert low[2] == high[2] == low[3] == high[3] == 0
    corners = np.array(np.meshgrid([0, 1], [0, 1])).reshape(2, -1).T
    for question in questions.values():
        low, high = bounds(question)
        places = low[:2] + corners * (high - low)[:2]
        # The unsafe sets are boxes: for so small a set of starts its corners decide.
        assert PLANT.margin(CLEARANCE, State.start(*places.T)).min() > 0
        assert (high - low)[:2].max() <= 0.2 + 1e-6


def test_a_wide_line_is_as_long_as_its_name_says(made):
    for name, question in made[1].items():
        if "line" in name:
            low, high = bounds(question)
            length = Fraction(int(name.split("line")[1].split("mm")[0]), 1000)
            width = Fraction(high[0]) - Fraction(low[0])
            assert length - Fraction(1, 2**22) <= width <= length
            assert (low[1:] == high[1:]).all()


def test_turned_left_the_answer_is_sat_by_a_witness_in_onnxruntime(made):
    graphs, questions = made
    turned = {name: q for name, q in questions.items() if ".left" in name}
    assert len(turned) >= 2
    for question in turned.values():
        low, high = bounds(question)
        starts = np.random.default_rng(0).uniform(low, high, size=(400, 4)).astype(np.float32)
        starts = np.clip(starts, low.astype(np.float32), high.astype(np.float32))
        margins = session(graphs[question.graph]).run(None, {"start": starts})[0]
        read = Read(print_spec(question.spec, "2.0"))
        worst = int(margins.min(axis=1).argmin())
        assert read.holds(starts[worst].tolist(), margins[worst].tolist())
        assert margins[worst].min() < -0.01
        # The simulator agrees, from the same start.
        state = State.start(*starts[worst : worst + 1].astype(float).T)
        steer = ControllerFile.load(FILE).controller.steering_rows
        steps = int(question.id.split(".k")[1].split(".")[0])
        assert simulate(PLANT, steer, CLEARANCE, state, steps).margin_sampled[0] < 0


def test_on_the_lines_no_sampled_start_is_a_witness_of_anything(made):
    graphs, questions = made
    tried = 0
    for name, question in questions.items():
        if "line" in name and not name.startswith("k70"):
            low, high = bounds(question)
            starts = np.linspace(low, high, 200).astype(np.float32)
            outputs = session(graphs[question.graph]).run(None, {"start": starts})[0]
            read = Read(print_spec(question.spec, "1.0"))
            pairs = zip(starts.tolist(), outputs.tolist(), strict=True)
            assert not any(read.holds(x, y) for x, y in pairs)
            tried += 1
    assert tried >= 9


def test_pattern_specifications_read_the_outputs_that_they_mean(made):
    _, questions = made
    k = 2
    name = next(n for n in questions if n.startswith("k2.line") and n.endswith("p0.safe"))
    safe = Read(print_spec(questions[name].spec, "2.0"))
    cover = Read(print_spec(questions[name.replace("safe", "cover")].spec, "2.0"))
    x = bounds(questions[name])[0].tolist()

    def outputs(margins, guards, covers):
        assert len(margins) == len(guards) == len(covers) == k
        return [*margins, *guards, *covers]

    fine = outputs([1, 1], [1, 1], [1, 1])
    assert not safe.holds(x, fine)
    assert not cover.holds(x, fine)
    assert safe.holds(x, outputs([0, 1], [0, -1], [1, 1]))
    assert safe.holds(x, outputs([1, -1], [1, 0], [1, 1]))
    assert not safe.holds(x, outputs([1, -1], [1, -1], [1, 1]))  # the pattern broke before
    assert cover.holds(x, outputs([1, 1], [-1, -1], [0, 1]))
    assert cover.holds(x, outputs([1, 1], [1, -1], [1, -1]))
    assert not cover.holds(x, outputs([1, 1], [-1, -1], [1, -1]))
    assert not cover.holds(x, outputs([1, 1], [1, -1], [1, 1]))  # another pattern goes on


def test_the_official_parser_takes_every_version_2_file(made):
    vnnlib = pytest.importorskip("vnnlib")
    for question in made[1].values():
        query = vnnlib.parse_query_string(print_spec(question.spec, "2.0"))
        assert len(query.assertions) >= 9


@pytest.mark.parametrize(("name", "rays"), [("TD3_L3200_8_C1", 3200), ("TD3_L5_8_C2", 5)])
def test_large_controllers_and_further_seeds_are_left_out(tmp_path, add_controller, name, rays):
    file = ControllerFile.load(add_controller(tmp_path, name, rays=rays))
    part = unrolled_part(file, benchmark_plant(rays, 4.0), "unrolled", 60, Draw())
    assert not part.files
    assert not part.asked

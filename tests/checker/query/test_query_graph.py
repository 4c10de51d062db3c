"""Models of ONNX graphs: against ONNX's own reference evaluation at points of boxes."""

import gzip
from pathlib import Path

import numpy as np
import onnx
import pytest
from asking import model
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from checker.files import Unreadable
from checker.models import bound
from checker.query.elements import interval
from checker.query.graph import Graph

REPOSITORY = Path(__file__).parents[3]
NAME = "TD3_L21_64x64_C1"
BINARY = ("Add", "Sub", "Mul", "Div", "Max", "Min")
UNARY = ("Tanh", "Sin", "Cos", "Neg", "Sigmoid", "Relu")


def in_doubles(content):
    """Return an evaluator of the same graph with double constants."""
    loaded = onnx.load_from_string(content)
    for tensor in loaded.graph.initializer:
        wide = numpy_helper.to_array(tensor).astype(np.float64)
        tensor.CopyFrom(numpy_helper.from_array(wide, tensor.name))
    for value in (*loaded.graph.input, *loaded.graph.output):
        value.type.tensor_type.elem_type = onnx.TensorProto.DOUBLE
    return ReferenceEvaluator(loaded)


def random_graph(random, size):
    """Return a graph of random operators on rows of 1 or 3 elements."""
    nodes, constants, widths = [], [], {"x": 3}
    matrix = random.normal(size=(3, 3)).astype(np.float32)
    constants += [numpy_helper.from_array(matrix, "m")]
    constants += [numpy_helper.from_array(random.normal(size=(1, 1)).astype(np.float32), "c")]
    constants += [numpy_helper.from_array(random.normal(size=(1, 3)).astype(np.float32), "d")]
    widths |= {"c": 1, "d": 3}
    for k in range(size):
        names = sorted(widths)
        a, b, c, d = (str(random.choice(names)) for _ in range(4))
        made, kind = f"t{k}", random.choice(["one", "two", "matrix", "where", "join"])
        if kind == "one":
            nodes.append(helper.make_node(str(random.choice(UNARY)), [a], [made]))
            widths[made] = widths[a]
        elif kind == "two":
            nodes.append(helper.make_node(str(random.choice(BINARY)), [a, b], [made]))
            widths[made] = max(widths[a], widths[b])
        elif kind == "matrix":
            wide = str(random.choice([n for n in names if widths[n] == 3 and n != "d"]))
            nodes.append(helper.make_node("MatMul", [wide, "m"], [made]))
            widths[made] = 3
        elif kind == "where":
            test = str(random.choice(["Greater", "GreaterOrEqual"]))
            nodes.append(helper.make_node(test, [a, b], [f"{made}.test"]))
            nodes.append(helper.make_node("Where", [f"{made}.test", c, d], [made]))
            widths[made] = max(widths[n] for n in (a, b, c, d))
        else:
            ones = [n for n in names if widths[n] == 1]
            three = [str(random.choice(ones)) for _ in range(3)]
            nodes.append(helper.make_node("Concat", three, [made], axis=1))
            widths[made] = 3
    last = max((n for n in widths if n[0] == "t"), key=lambda n: int(n[1:]))
    return model(nodes, constants, 3, widths[last], last)


def holds(case, outputs):
    """Whether outputs lie in their models, up to the evaluator's rounding."""
    for z, y in zip(case, outputs.tolist(), strict=True):
        low, high = interval(z)
        room = 1e-9 * (1 + abs(y))
        # Nothing is said of what is not finite; a quotient may enlarge rounding.
        if np.isfinite(y) and abs(y) < 1e6 and (y < low - room or y > high + room):
            return False
    return True


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32),
    size=st.integers(1, 12),
    half=st.lists(st.sampled_from([0.0, 1e-6, 0.02, 0.3]), min_size=3, max_size=3),
)
def test_values_lie_in_their_models(seed, size, half):
    random = np.random.default_rng(seed)
    content = random_graph(random, size)
    middle = random.normal(size=3)
    lower, upper = middle - half, middle + half
    try:
        cases = Graph(content, "graph").values(lower, upper)
    except ArithmeticError:
        return
    evaluator = in_doubles(content)
    points = [lower, upper, *(random.uniform(lower, upper) for _ in range(6))]
    with np.errstate(all="ignore"):
        for point in points:
            (outputs,) = evaluator.run(None, {"x": point[None]})
            assert any(holds(case, outputs[0]) for case in cases)


@pytest.mark.parametrize(
    ("graph", "lower"),
    [("k2", [0.74, 5.0, 2.4, 0.0]), ("k2.line100mm.p0", [0.60, 1.75, 2.396484375, -0.29])],
)
def test_an_unrolled_loop_lies_in_its_models(graph, lower):
    file = REPOSITORY / "onnx" / "unrolled" / f"{NAME}.{graph}.onnx.gz"
    content = gzip.decompress(file.read_bytes())
    lower = np.array(lower)
    upper = lower + np.array([0.02, 0.01, 0.0, 0.01])
    cases = Graph(content, "graph").values(lower, upper)
    assert all(bound(z).rad() < 0.2 for case in cases for z in case)
    evaluator, random = in_doubles(content), np.random.default_rng(1)
    for point in random.uniform(lower, upper, size=(20, 4)):
        (outputs,) = evaluator.run(None, {"start": point[None]})
        assert any(holds(case, outputs[0]) for case in cases)


def test_a_quotient_by_what_may_be_zero_is_not_defined():
    one = numpy_helper.from_array(np.ones((1, 1), np.float32), "c")
    content = model([helper.make_node("Div", ["c", "x"], ["t0"])], [one], 1, 1, "t0")
    graph = Graph(content, "graph")
    box = np.array([-1.0]), np.array([1.0])
    with pytest.raises(ArithmeticError):
        graph.values(*box)
    assert np.isnan(graph.least(box[0][None], box[1][None], np.array([[1.0]]))).all()


def numbers(**values):
    return [numpy_helper.from_array(np.full((1, 1), x, np.float32), n) for n, x in values.items()]


def test_an_open_comparison_is_followed_to_both_ends():
    """|x|, which a hull of x and -x would let be negative."""
    nodes = [
        helper.make_node("Greater", ["x", "zero"], ["positive"]),
        helper.make_node("Neg", ["x"], ["turned"]),
        helper.make_node("Where", ["positive", "x", "turned"], ["t0"]),
    ]
    graph = Graph(model(nodes, numbers(zero=0.0), 1, 1, "t0"), "graph")
    box = np.array([[-1.0]]), np.array([[1.0]])
    (ends,) = graph.least(*box, np.array([[1.0], [-1.0]]))
    assert len(graph.values(box[0][0], box[1][0])) == 2
    assert ends == pytest.approx([0.0, -1.0], abs=1e-6)


def test_a_quotient_by_what_is_nearly_zero_is_large():
    """min(y / max(x, 1e-6), 3) is 3 for small x and y of about 1, and max(-y / ..., 0) is 0."""
    nodes = [
        helper.make_node("MatMul", ["x", "first"], ["g"]),
        helper.make_node("MatMul", ["x", "second"], ["h"]),
        helper.make_node("Max", ["g", "tiny"], ["beyond"]),
        helper.make_node("Div", ["h", "beyond"], ["u"]),
        helper.make_node("MatMul", ["u", "signs"], ["both"]),
        helper.make_node("Min", ["both", "three"], ["least"]),
        helper.make_node("Max", ["least", "zero"], ["t0"]),
    ]
    constants = numbers(tiny=1e-6, three=3.0, zero=0.0)
    for name, column in (("first", [[1], [0]]), ("second", [[0], [1]]), ("signs", [[1, -1]])):
        constants.append(numpy_helper.from_array(np.array(column, np.float32), name))
    graph = Graph(model(nodes, constants, 2, 2, "t0"), "graph")
    box = np.array([[-1e-3, 0.9]]), np.array([[1e-3, 1.1]])
    ends = graph.least(*box, np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))[0]
    assert ends == pytest.approx([3.0, -3.0, 0.0, 0.0], abs=1e-9)


def test_where_takes_comparisons_only():
    content = model([helper.make_node("Where", ["x", "x", "c"], ["t0"])],
                    [numpy_helper.from_array(np.ones((1, 1), np.float32), "c")],
                    1, 1, "t0")  # fmt: skip
    box = np.array([[1.0]]), np.array([[2.0]])
    assert np.isnan(Graph(content, "graph").least(*box, np.array([[1.0]]))).all()


@pytest.mark.parametrize(
    "node",
    [
        helper.make_node("Exp", ["x"], ["t0"]),
        helper.make_node("Add", ["x", "y"], ["t0"]),
        helper.make_node("MatMul", ["m", "x"], ["t0"]),
        helper.make_node("Add", ["x", "m"], ["t0"]),
        helper.make_node("Gemm", ["x", "m"], ["t0"], alpha=2.0),
        helper.make_node("Concat", ["x", "x"], ["t0"], axis=0),
        helper.make_node("Add", ["x", "deep"], ["t0"]),
    ],
)
def test_what_is_not_known_is_refused(node):
    constants = [numpy_helper.from_array(np.eye(2, dtype=np.float32), "m")]
    constants += [numpy_helper.from_array(np.zeros((1, 1, 2), np.float32), "deep")]
    graph = helper.make_graph(
        [node],
        "graph",
        [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, ["batch", 2])],
        [helper.make_tensor_value_info("t0", onnx.TensorProto.FLOAT, ["batch", 2])],
        constants,
    )
    with pytest.raises(Unreadable):
        Graph(helper.make_model(graph).SerializeToString(), "graph")

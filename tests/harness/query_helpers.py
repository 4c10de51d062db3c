"""Small networks and queries, and witnesses in both syntaxes."""

import sys
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from harness.query.read import read_query

sys.path.insert(0, str(Path(__file__).parents[1]))  # vnnlib_reader

REPOSITORY = Path(__file__).parents[2]
PUBLISHED = sorted((REPOSITORY / "vnnlib").glob("*/*/*.vnnlib*"))


def linear_network(weights, dtype=np.float32, batch="batch"):
    """Return the content of an ONNX file: Y = X @ weights, X of shape [1, n]."""
    weights = np.asarray(weights, dtype)
    kind = TensorProto.FLOAT if dtype == np.float32 else TensorProto.DOUBLE
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "w"], ["y"])],
        "linear",
        [helper.make_tensor_value_info("x", kind, [batch, weights.shape[0]])],
        [helper.make_tensor_value_info("y", kind, [batch, weights.shape[1]])],
        [numpy_helper.from_array(weights, "w")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    return model.SerializeToString()


def query_1(inputs, outputs, *assertions):
    """Return the text of a query in 1.0."""
    declared = [f"(declare-const X_{i} Real)" for i in range(inputs)]
    declared += [f"(declare-const Y_{i} Real)" for i in range(outputs)]
    return "\n".join([*declared, *(f"(assert {a})" for a in assertions)]) + "\n"


def query_2(inputs, outputs, *assertions):
    """Return the text of the same query in 2.0; elements are called as in 1.0."""
    text = "\n".join(f"(assert {a})" for a in assertions) + "\n"
    for name, count in (("X", inputs), ("Y", outputs)):
        for i in range(count):
            text = text.replace(f"{name}_{i}", f"{name}[0,{i}]")
    return (
        "(vnnlib-version <2.0>)\n(declare-network N\n"
        f"  (declare-input X float32 [1,{inputs}])\n  (declare-output Y float32 [1,{outputs}])\n)\n"
    ) + text


def read(text):
    return read_query(text, "query")


def witness_1(inputs, outputs=()):
    pairs = [f"(X_{i} {x!r})" for i, x in enumerate(inputs)]
    pairs += [f"(Y_{i} {y!r})" for i, y in enumerate(outputs)]
    return ("(" + "\n".join(pairs) + ")").encode()


def witness_2(inputs, outputs):
    lines = [f"X float32 [1,{len(inputs)}]", *map(repr, inputs)]
    lines += [f"Y float32 [1, {len(outputs)}]", *map(repr, outputs)]
    return "\n".join(lines).encode()

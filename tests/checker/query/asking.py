"""Small networks as ONNX files, and questions about them, for the tests of proofs and checks."""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

ACTIVATIONS = ("Tanh", "Sigmoid", "Relu", "")


def some_layers(random, sizes, kinds):
    """Return (weights, biases, activation) for layers of these sizes, inputs first."""
    return [
        (
            random.normal(size=(b, a)).astype(np.float32) * np.float32(1.5 / a**0.5),
            random.normal(size=b).astype(np.float32) * np.float32(0.3),
            kind,
        )
        for a, b, kind in zip(sizes[:-1], sizes[1:], kinds, strict=True)
    ]


def chain(layers):
    """Return the ONNX file of a chain of layers: Gemm and activation."""
    nodes, constants, x = [], [], "x"
    for i, (weights, biases, kind) in enumerate(layers):
        constants += [numpy_helper.from_array(weights, f"w{i}")]
        constants += [numpy_helper.from_array(biases, f"b{i}")]
        nodes.append(helper.make_node("Gemm", [x, f"w{i}", f"b{i}"], [f"z{i}"], transB=1))
        x = f"z{i}"
        if kind:
            nodes.append(helper.make_node(kind, [x], [f"y{i}"]))
            x = f"y{i}"
    return model(nodes, constants, layers[0][0].shape[1], len(layers[-1][0]), x)


def model(nodes, constants, inputs, outputs, last):
    """Return an ONNX file with input x and output ``last``, one row each."""
    graph = helper.make_graph(
        nodes,
        "graph",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["batch", inputs])],
        [helper.make_tensor_value_info(last, TensorProto.FLOAT, ["batch", outputs])],
        constants,
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    made.ir_version = 8
    onnx.checker.check_model(made)
    return made.SerializeToString()


def computed(layers, x):
    """Return the outputs of a chain in float64 at points ``[points, inputs]``."""
    for weights, biases, kind in layers:
        x = x @ weights.astype(float).T + biases.astype(float)
        if kind == "Tanh":
            x = np.tanh(x)
        elif kind == "Sigmoid":
            x = 0.5 + 0.5 * np.tanh(0.5 * x)
        elif kind == "Relu":
            x = np.maximum(x, 0)
    return x


def decimal(value):
    """Return a float as a plain decimal that is exactly it."""
    return format(Decimal(float(value)), "f")


def question(lower, upper, *conditions, outputs=1):
    """Return VNN-LIB 1.0: inputs in a box, and assertions about outputs."""
    lines = [f"(declare-const X_{i} Real)" for i in range(len(lower))]
    lines += [f"(declare-const Y_{i} Real)" for i in range(outputs)]
    for i, (a, b) in enumerate(zip(lower, upper, strict=True)):
        lines += [f"(assert (>= X_{i} {decimal(a)}))", f"(assert (<= X_{i} {decimal(b)}))"]
    lines += [f"(assert {condition})" for condition in conditions]
    return "\n".join(lines) + "\n"

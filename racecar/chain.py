"""Layers as a chain of ONNX nodes, written and read.

A layer is a Gemm node, or a Conv node over ``[batch, channels, 1, places]``: two-dimensional with
a height of 1, which more verifiers read than the one-dimensional form. An activation follows or
nothing. Reshape and Flatten stand where a convolution begins and where the last one ends.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from racecar.errors import BadInput
from racecar.layers import Convolution, Layer

ACTIVATIONS = {"Tanh": "tanh", "Sigmoid": "sigmoid", "Relu": "relu"}
_OPERATORS = {name: operator for operator, name in ACTIVATIONS.items()}
_SHAPES = ("Reshape", "Unsqueeze", "Flatten")

Values = dict[str, NDArray]


def write_chain(
    layers: tuple[Layer, ...], x: str, last: str
) -> tuple[list[onnx.NodeProto], list[TensorProto]]:
    """Return nodes and initializers that lead from the value named ``x`` to ``last``."""
    nodes, initializers, flat = [], [], True
    for i, layer in enumerate(layers):
        name, convolution = f"layer{i}", layer.convolution
        kernels = layer.weights if convolution is None else convolution.kernels[:, :, None]
        biases = layer.biases if convolution is None else convolution.biases
        shaped = f"{name}.in"
        if convolution is None and not flat:
            nodes.append(helper.make_node("Flatten", [x], [shaped], shaped, axis=1))
            x = shaped
        elif convolution is not None and flat:
            shape = np.array([-1, kernels.shape[1], 1, convolution.length], dtype=np.int64)
            initializers.append(numpy_helper.from_array(shape, f"{name}.shape"))
            nodes.append(helper.make_node("Reshape", [x, f"{name}.shape"], [shaped], shaped))
            x = shaped
        flat = convolution is None
        inputs = [x, f"{name}.weight", f"{name}.bias"]
        initializers += [
            numpy_helper.from_array(np.ascontiguousarray(value), key)
            for key, value in zip(inputs[1:], (kernels, biases), strict=True)
        ]
        linear = layer.activation == "linear"
        y = last if linear and i == len(layers) - 1 else f"{name}.sum"
        nodes.append(
            helper.make_node("Gemm", inputs, [y], name, transB=1)
            if convolution is None
            else _conv_node(convolution, inputs, y, name)
        )
        if not linear:
            x, y = y, last if i == len(layers) - 1 else f"{name}.out"
            operator = _OPERATORS[layer.activation]
            nodes.append(helper.make_node(operator, [x], [y], f"{name}.{layer.activation}"))
        x = y
    return nodes, initializers


def _conv_node(convolution: Convolution, inputs: list[str], y: str, name: str) -> onnx.NodeProto:
    # Defaults are spelled out too, for readers that want them.
    return helper.make_node(
        "Conv", inputs, [y], name,
        kernel_shape=[1, convolution.kernels.shape[2]], strides=[1, convolution.stride],
        pads=[0, 0, 0, 0], dilations=[1, 1], group=1,
    )  # fmt: skip


def read_chain(
    graph: onnx.GraphProto, x: onnx.ValueInfoProto, values: Values, where: str
) -> tuple[Layer, ...]:
    """Return the layers that lead from the input ``x`` to the output.

    values: the graph's constants by name. Raises BadInput, naming ``where``, if it is not one
    chain of nodes that are understood.
    """
    layers: list[Layer] = []
    name, shape = x.name, _input_shape(x)
    # Whether the shape (behind the batch) binds; the input's own is checked against the layers.
    bound = False
    for node in graph.node:
        label = node.name or node.op_type
        known = node.op_type in {"Gemm", "Conv", *_SHAPES, *ACTIVATIONS}
        if not known or node.domain not in {"", "ai.onnx"}:
            raise BadInput(
                f"{where}: operator {node.op_type} is not understood here; use Gemm or Conv "
                f"followed by {', '.join(ACTIVATIONS)} or nothing"
            )
        if node.input[0] != name or len(node.output) != 1:
            raise BadInput(f"{where}: node {label} is not part of one chain of layers")
        name = node.output[0]
        if node.op_type in _SHAPES:
            shape, bound = _reshaped(node, shape, values, where), True
        elif node.op_type == "Gemm":
            layers.append(_read_gemm(node, values, where))
            out, into = layers[-1].weights.shape
            if bound and shape != (into,):
                raise BadInput(f"{where}: node {label} does not fit the layer before it")
            shape, bound = (out,), True
        elif node.op_type == "Conv":
            convolution = _read_conv(node, shape, values, where)
            layers.append(convolution.layer("linear"))
            shape = (len(convolution.kernels), *shape[1:-1], convolution.places)
        elif layers and layers[-1].activation == "linear":
            layers[-1] = replace(layers[-1], activation=ACTIVATIONS[node.op_type])
        else:
            raise BadInput(f"{where}: node {label} does not follow a Gemm or Conv")
    if not layers or name != graph.output[0].name:
        raise BadInput(f"{where}: no chain of layers leads from the input to the output")
    if len(shape) != 1:
        raise BadInput(f"{where}: {name} is not of shape [batch, 1]; let Flatten and Gemm follow")
    return tuple(layers)


def _input_shape(x: onnx.ValueInfoProto) -> tuple[int, ...]:
    """Return an input's shape behind the batch, 0 where it is not fixed."""
    return tuple(d.dim_value for d in x.type.tensor_type.shape.dim[1:])


def _reshaped(
    node: onnx.NodeProto, shape: tuple[int, ...], values: Values, where: str
) -> tuple[int, ...]:
    """Return the shape behind the batch after a node that only changes the shape."""
    given = _attributes(node)
    refused = BadInput(
        f"{where}: node {node.name or node.op_type} is not understood; let it keep the batch, "
        "free, in front and give the other sizes"
    )
    if node.op_type == "Flatten":
        if given.get("axis", 1) != 1:
            raise refused
        return (math.prod(shape),)
    constant = values.get(node.input[1]) if len(node.input) > 1 else None
    wanted = [int(v) for v in (constant if constant is not None else np.array([])).reshape(-1)]
    if node.op_type == "Unsqueeze":
        rank = 1 + len(shape) + len(wanted)
        axes = sorted(v % rank for v in wanted)
        if not axes or axes[0] == 0 or len({*axes}) < len(axes):
            raise refused
        sizes = list(shape)
        for axis in axes:
            sizes.insert(axis - 1, 1)
        return tuple(sizes)
    batch, *sizes = wanted or [1]
    if batch not in {-1, 0} or not sizes or min(sizes) < 1 or given.get("allowzero", 0):
        raise refused
    if 0 not in shape and math.prod(sizes) != math.prod(shape):
        raise BadInput(f"{where}: node {node.name} makes {wanted} of {math.prod(shape)} values")
    return tuple(sizes)


def _attributes(node: onnx.NodeProto) -> dict[str, Any]:
    return {a.name: helper.get_attribute_value(a) for a in node.attribute}


def _read_conv(
    node: onnx.NodeProto, shape: tuple[int, ...], values: Values, where: str
) -> Convolution:
    """Read a convolution over values of a shape (channels, places) or (channels, 1, places)."""
    given = _attributes(node)
    kernels, biases = _constants(node, values, where)
    plain = (
        given.get("group", 1) == 1
        and given.get("auto_pad", b"NOTSET") in {b"NOTSET", b"VALID"}
        and not any(given.get("pads", []))
        and min(given.get("strides", [1])) > 0
        and set(given.get("dilations", [1])) == {1}
        and given.get("kernel_shape", [*kernels.shape[2:]]) == [*kernels.shape[2:]]
    )
    along = 0 not in shape and (*shape[1:-1], *kernels.shape[2:-1]) in {(), (1, 1)}
    if not plain or not along or len(shape) != kernels.ndim - 1:
        raise BadInput(
            f"{where}: node {node.name} is not a plain convolution along the scan; give it values "
            "of shape [batch, channels, 1, places], and no padding, dilation or groups"
        )
    if kernels.shape[1] != shape[0] or kernels.shape[-1] > shape[-1]:
        raise BadInput(f"{where}: node {node.name} does not fit the layer before it")
    kernels = kernels.reshape(*kernels.shape[:2], -1)
    stride = int(given.get("strides", [1])[-1])
    return Convolution(kernels, _per_output(biases, kernels, node, where), stride, shape[-1])


def _read_gemm(node: onnx.NodeProto, values: Values, where: str) -> Layer:
    given = _attributes(node)
    scaled = given.get("alpha", 1.0) != 1.0 or given.get("beta", 1.0) != 1.0
    if scaled or given.get("transA", 0):
        raise BadInput(f"{where}: node {node.name} scales or transposes its input; use plain Gemm")
    weights, biases = _constants(node, values, where)
    weights = np.ascontiguousarray(weights if given.get("transB", 0) else weights.T)
    return Layer(weights, _per_output(biases, weights, node, where), "linear")


def _constants(
    node: onnx.NodeProto, values: Values, where: str
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return the weights of a Gemm or Conv, and its biases if it has some."""
    biased = len(node.input) > 2 and node.input[2] != ""
    weights = values.get(node.input[1])
    biases = values.get(node.input[2]) if biased else None
    ranks = {2} if node.op_type == "Gemm" else {3, 4}
    if weights is None or weights.ndim not in ranks or not weights.size:
        raise BadInput(f"{where}: node {node.name} has no constant weights")
    if biased and biases is None:
        raise BadInput(f"{where}: node {node.name} has no constant weights")
    both = [weights] if biases is None else [weights, biases]
    if any(x.dtype != np.float32 for x in both):
        raise BadInput(f"{where}: node {node.name} is not float32")
    if not all(np.isfinite(x).all() for x in both):
        raise BadInput(f"{where}: node {node.name} holds values that are not finite (NaN or inf)")
    return weights, biases


def _per_output(
    biases: NDArray[np.float32] | None, weights: NDArray, node: onnx.NodeProto, where: str
) -> NDArray[np.float32]:
    """Return biases ``[out]`` for weights ``[out, ...]``: zeros if there are none."""
    count = len(weights)
    if biases is None:
        return np.zeros(count, dtype=np.float32)
    if biases.shape not in {(count,), (1, count)}:
        raise BadInput(
            f"{where}: node {node.name} has biases of shape {list(biases.shape)} "
            f"for {count} neurons"
        )
    return biases.reshape(-1)

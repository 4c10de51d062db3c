"""Convolutional controllers: Conv nodes in the file, ordinary layers for all else."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from racecar.controller import (
    Controller,
    RuntimeSteer,
    load_controller,
    parse_controller,
    save_controller,
    to_model,
    weights_sha256,
)
from racecar.errors import BadInput
from racecar.layers import Convolution, Layer


def normal(random: np.random.Generator, *shape: int) -> np.ndarray:
    return random.normal(0, 1 / np.sqrt(shape[-1]), shape).astype(np.float32)


def convolutional(
    seed: int = 0, rays: int = 41, sizes: tuple[tuple[int, int, int], ...] = ((3, 5, 3), (2, 4, 2))
) -> Controller:
    """Return a controller with convolutions of (channels, kernel, stride), then 6 neurons."""
    random = np.random.default_rng(seed)
    channels, length, layers = 1, rays, []
    for out, kernel, stride in sizes:
        kernels = normal(random, out, channels, kernel)
        layers.append(Convolution(kernels, normal(random, out), stride, length).layer("tanh"))
        channels, length = out, (length - kernel) // stride + 1
    widths = [channels * length, 6, 1]
    for into, out in itertools.pairwise(widths):
        layers.append(Layer(normal(random, out, into), normal(random, out), "tanh"))
    return Controller(tuple(layers), {"name": "test"})


CONTROLLERS = st.builds(
    convolutional,
    seed=st.integers(0, 2**32 - 1),
    rays=st.integers(30, 70),
    sizes=st.lists(
        st.tuples(st.integers(1, 3), st.integers(1, 5), st.integers(1, 3)), min_size=1, max_size=2
    ).map(tuple),
)


def by_hand(convolution: Convolution, x: np.ndarray) -> np.ndarray:
    """Slide the kernels: sums ``[channels out, places]`` for ``[channels in, length]``."""
    kernels = convolution.kernels.astype(float)
    windows = np.lib.stride_tricks.sliding_window_view(x, kernels.shape[2], axis=1)
    sums = np.einsum("ock,cpk->op", kernels, windows[:, :: convolution.stride])
    return sums + convolution.biases[:, None]


@given(CONTROLLERS, st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_layers_are_the_convolution_spelt_out(controller, seed):
    x = np.random.default_rng(seed).uniform(0, 5, (1, controller.rays))
    for layer in controller.layers:
        if layer.convolution is None:
            break
        expected = by_hand(layer.convolution, x)
        sums = layer.weights.astype(float) @ x.reshape(-1) + layer.biases
        np.testing.assert_allclose(sums, expected.reshape(-1), rtol=1e-12, atol=1e-12)
        x = np.tanh(expected)


@given(CONTROLLERS, st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_the_file_has_conv_nodes_and_onnxruntime_agrees(controller, seed):
    """onnxruntime runs the Conv nodes; steering multiplies with the dense weights."""
    model = to_model(controller)
    kinds = [node.op_type for node in model.graph.node]
    convolutions = [x.convolution for x in controller.layers if x.convolution is not None]
    assert kinds == ["Reshape", *["Conv", "Tanh"] * len(convolutions), "Flatten",
                     "Gemm", "Tanh", "Gemm", "Tanh"]  # fmt: skip
    scan = np.random.default_rng(seed).uniform(0, 5, (50, controller.rays)).astype(np.float32)
    run = RuntimeSteer(controller)(scan.T)
    assert np.abs(run - controller.steering(scan)).max() < 1e-5
    # The batch stays free behind the Reshape.
    alone = [RuntimeSteer(controller)(row[:, None])[0] for row in scan[:3]]
    np.testing.assert_allclose(alone, run[:3], atol=1e-6)


@given(CONTROLLERS)
@settings(max_examples=15, deadline=None)
def test_reading_gives_back_what_was_written(controller):
    content = to_model(controller).SerializeToString(deterministic=True)
    again = parse_controller(content, "test")
    for one, other in zip(again.layers, controller.layers, strict=True):
        assert one.activation == other.activation
        assert (one.weights == other.weights).all()
        assert (one.biases == other.biases).all()
        assert (one.convolution is None) == (other.convolution is None)
    assert to_model(again).SerializeToString(deterministic=True) == content
    assert weights_sha256(again) == weights_sha256(controller)


def test_the_dense_form_is_the_same_network():
    """A file without Conv nodes: other bytes, the same hash of layers."""
    controller = convolutional()
    dense = Controller(tuple(replace(x, convolution=None) for x in controller.layers))
    assert {x.op_type for x in to_model(dense).graph.node} == {"Gemm", "Tanh"}
    assert weights_sha256(dense) == weights_sha256(controller)


def test_weights_that_are_not_the_convolutions_are_refused():
    layer = convolutional().layers[0]
    with pytest.raises(ValueError, match="not those of its convolution"):
        replace(layer, weights=layer.weights + 1)


def foreign(nodes: list[Any], initializers: dict[str, np.ndarray]) -> bytes:
    """Return a file as others write them."""
    graph = helper.make_graph(
        nodes,
        "foreign",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 12])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", 1])],
        [numpy_helper.from_array(v, k) for k, v in initializers.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    return model.SerializeToString()


def test_a_one_dimensional_convolution_as_torch_exports_it_is_read(tmp_path: Path):
    random = np.random.default_rng(0)
    kernels, biases, row = normal(random, 2, 1, 4), normal(random, 2), normal(random, 6, 1)
    nodes = [
        helper.make_node("Unsqueeze", ["x", "axes"], ["a"], "unsqueeze"),
        helper.make_node("Conv", ["a", "k", "b"], ["c"], "conv", strides=[4], kernel_shape=[4]),
        helper.make_node("Relu", ["c"], ["d"], "relu"),
        helper.make_node("Reshape", ["d", "flat"], ["e"], "flatten"),
        helper.make_node("Gemm", ["e", "row"], ["y"], "gemm"),
    ]
    constants = {"axes": np.array([1]), "k": kernels, "b": biases,
                 "flat": np.array([-1, 6]), "row": row}  # fmt: skip
    (tmp_path / "c.onnx").write_bytes(foreign(nodes, constants))
    controller = load_controller(tmp_path / "c.onnx")
    scan = random.uniform(0, 5, (20, 12)).astype(np.float32)
    expected = RuntimeSteer(tmp_path / "c.onnx")(scan.T)
    np.testing.assert_allclose(controller.steering(scan), expected, atol=1e-5)
    save_controller(controller, tmp_path / "again.onnx")  # in this package's form
    np.testing.assert_allclose(RuntimeSteer(tmp_path / "again.onnx")(scan.T), expected, atol=1e-5)


def changed(change: Callable[[onnx.ModelProto], Any]) -> bytes:
    model = to_model(convolutional())
    change(model)
    return model.SerializeToString()


def attribute(name: str, value: Any) -> bytes:
    def change(model: onnx.ModelProto) -> None:
        conv = model.graph.node[1]
        kept = [a for a in conv.attribute if a.name != name]
        del conv.attribute[:]
        conv.attribute.extend([*kept, helper.make_attribute(name, value)])

    return changed(change)


def initializer(name: str, change: Callable[[np.ndarray], np.ndarray]) -> bytes:
    def work(model: onnx.ModelProto) -> None:
        (found,) = (x for x in model.graph.initializer if x.name == name)
        new = np.ascontiguousarray(change(numpy_helper.to_array(found).copy()))
        found.CopyFrom(numpy_helper.from_array(new, name))

    return changed(work)


def flatten_from_2(model: onnx.ModelProto) -> None:
    (node,) = (x for x in model.graph.node if x.op_type == "Flatten")
    node.attribute[0].i = 2


def no_flatten(model: onnx.ModelProto) -> None:
    (node,) = (x for x in model.graph.node if x.op_type == "Flatten")
    model.graph.node.remove(node)
    next(x for x in model.graph.node if x.op_type == "Gemm").input[0] = node.input[0]


NAN = np.float32("nan")
BAD_FILES = {
    "padding": (attribute("pads", [0, 1, 0, 1]), "not a plain convolution"),
    "dilation": (attribute("dilations", [1, 2]), "not a plain convolution"),
    "no stride": (attribute("strides", [1, 0]), "not a plain convolution"),
    "groups": (attribute("group", 2), "not a plain convolution"),
    "automatic padding": (attribute("auto_pad", "SAME_UPPER"), "not a plain convolution"),
    "kernel shape": (attribute("kernel_shape", [1, 4]), "not a plain convolution"),
    "fixed batch": (initializer("layer0.shape", lambda x: [1, 1, 1, 41] + 0 * x), "keep the batch"),
    "other size": (initializer("layer0.shape", lambda x: [-1, 1, 1, 40] + 0 * x), "of 41 values"),
    "height": (initializer("layer0.weight", lambda x: np.repeat(x, 2, 2)), "not a plain"),
    "channels": (initializer("layer1.weight", lambda x: x[:, :2]), "layer1 does not fit"),
    "NaN": (initializer("layer0.weight", lambda x: x * NAN), "layer0 holds values that are not"),
    "bias width": (initializer("layer0.bias", lambda x: x[:2]), "layer0 has biases of shape [2]"),
    "float64": (initializer("layer0.weight", lambda x: x.astype(float)), "layer0 is not float32"),
    "flattened with the batch": (changed(flatten_from_2), "keep the batch"),
    "not flattened": (changed(no_flatten), "layer2 does not fit the layer before it"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_refused_in_one_line(name, tmp_path):
    content, message = BAD_FILES[name]
    path = tmp_path / "bad.onnx"
    path.write_bytes(content)
    with pytest.raises(BadInput) as caught:
        load_controller(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)

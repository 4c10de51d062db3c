"""Controller files: written the same every time, read back, run, and refused when bad."""

from __future__ import annotations

import threading
from collections.abc import Callable
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
    Layer,
    RuntimeSteer,
    load_controller,
    parse_controller,
    runtime_session,
    save_controller,
    to_model,
    weights_sha256,
    write_whole,
)
from racecar.errors import BadInput

ACTIVATIONS = ["tanh", "sigmoid", "relu", "linear"]


def random_controller(
    seed: int = 0, rays: int = 21, hidden: tuple[str, ...] = ("tanh", "tanh"), last: str = "tanh"
) -> Controller:
    random = np.random.default_rng(seed)
    widths = [rays, *(int(x) for x in random.integers(1, 20, len(hidden))), 1]
    layers = []
    for into, out, activation in zip(widths[:-1], widths[1:], [*hidden, last], strict=True):
        weights = random.normal(0, 1 / np.sqrt(into), (out, into)).astype(np.float32)
        layers.append(Layer(weights, random.normal(0, 1, out).astype(np.float32), activation))
    return Controller(tuple(layers), {"name": "test", "seed": str(seed)})


CONTROLLERS = st.builds(
    random_controller,
    seed=st.integers(0, 2**32 - 1),
    rays=st.integers(2, 70),
    hidden=st.lists(st.sampled_from(ACTIVATIONS), max_size=3).map(tuple),
    last=st.sampled_from(ACTIVATIONS),
)


@given(CONTROLLERS)
@settings(max_examples=30)
def test_reading_gives_back_what_was_written(controller):
    content = to_model(controller).SerializeToString(deterministic=True)
    again = parse_controller(content, "test")
    assert again.metadata == controller.metadata
    assert again.rays == controller.rays
    assert len(again.layers) == len(controller.layers)
    for one, other in zip(again.layers, controller.layers, strict=True):
        assert one.activation == other.activation
        assert one.weights.dtype == one.biases.dtype == np.float32
        assert (one.weights == other.weights).all()
        assert (one.biases == other.biases).all()
    assert weights_sha256(again) == weights_sha256(controller)


def test_files_are_the_same_byte_for_byte(tmp_path: Path):
    controller = random_controller()
    reordered = Controller(controller.layers, dict(reversed(controller.metadata.items())))
    save_controller(controller, tmp_path / "a.onnx")
    save_controller(reordered, tmp_path / "deep" / "b.onnx")
    save_controller(load_controller(tmp_path / "a.onnx"), tmp_path / "c.onnx")
    contents = {(tmp_path / x).read_bytes() for x in ("a.onnx", "deep/b.onnx", "c.onnx")}
    assert len(contents) == 1
    assert sorted(x.name for x in tmp_path.iterdir()) == ["a.onnx", "c.onnx", "deep"]


def test_the_format_is_as_described(tmp_path: Path):
    """Raw distances ``scan`` float32 [batch, n] in, ``steering`` float32 [batch, 1] out."""
    save_controller(random_controller(rays=41), tmp_path / "c.onnx")
    session = runtime_session(tmp_path / "c.onnx")
    (scan,), (steering,) = session.get_inputs(), session.get_outputs()
    assert (scan.name, scan.type, scan.shape) == ("scan", "tensor(float)", ["batch", 41])
    assert (steering.name, steering.type) == ("steering", "tensor(float)")
    assert steering.shape == ["batch", 1]
    assert session.get_modelmeta().custom_metadata_map == {"name": "test", "seed": "0"}


def by_hand(controller: Controller, scan: np.ndarray) -> float:
    x = [float(v) for v in scan]
    functions: dict[str, Callable[[float], float]] = {
        "tanh": np.tanh,
        "sigmoid": lambda v: 1 / (1 + np.exp(-v)),
        "relu": lambda v: max(v, 0.0),
        "linear": lambda v: v,
    }
    for layer in controller.layers:
        sums = [
            sum(float(w) * v for w, v in zip(row, x, strict=True)) + float(b)
            for row, b in zip(layer.weights, layer.biases, strict=True)
        ]
        x = [float(functions[layer.activation](v)) for v in sums]
    return x[0]


@given(CONTROLLERS, st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_steering_is_the_real_valued_network(controller, seed):
    scan = np.random.default_rng(seed).uniform(0, 5, (3, controller.rays))
    expected = [by_hand(controller, row) for row in scan]
    assert controller.steering(scan) == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert controller.steering_rows(scan.T) == pytest.approx(expected, rel=1e-12, abs=1e-12)


@given(CONTROLLERS, st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_onnxruntime_agrees_to_float32_rounding(controller, seed):
    scan = np.random.default_rng(seed).uniform(0, 5, (50, controller.rays)).astype(np.float32)
    exact, run = controller.steering(scan), RuntimeSteer(controller)(scan.T)
    assert run.dtype == np.float64
    # What float32 sums and activations can lose, layer by layer, with room to spare.
    magnitude, error = np.full(controller.rays, 5.0), np.zeros(controller.rays)
    for layer in controller.layers:
        size = np.abs(layer.weights).astype(float)
        terms = size.shape[1] + 8
        error = size @ error + terms * 2.0**-24 * (size @ magnitude + np.abs(layer.biases))
        magnitude = size @ magnitude + np.abs(layer.biases)
        if layer.activation in {"tanh", "sigmoid"}:
            error, magnitude = error + 1e-6, np.minimum(magnitude, 1.0)
            magnitude = np.maximum(magnitude, 0.5)
    assert np.abs(run - exact).max() <= error[0] + 1e-7


def test_a_file_and_the_controller_in_it_steer_alike(tmp_path: Path):
    controller = random_controller()
    save_controller(controller, tmp_path / "c.onnx")
    scan = np.random.default_rng(0).uniform(0, 5, (21, 1000))
    from_file, from_memory = RuntimeSteer(tmp_path / "c.onnx"), RuntimeSteer(controller)
    assert from_file.rays == from_memory.rays == 21
    assert (from_file(scan) == from_memory(scan)).all()
    session = runtime_session(tmp_path / "c.onnx")
    (outputs,) = session.run(None, {"scan": scan.T.astype(np.float32)})
    assert (from_file(scan) == outputs[:, 0]).all()


def test_large_inputs_do_not_overflow():
    layers = (
        Layer(np.array([[1e30], [-1e30]], np.float32), np.zeros(2, np.float32), "sigmoid"),
        Layer(np.array([[1, 1]], np.float32), np.zeros(1, np.float32), "linear"),
    )
    assert Controller(layers).steering(np.array([[5.0]])) == [1.0]


def test_the_hash_tells_weights_and_activations_apart():
    one = random_controller(0)
    hashes = {
        weights_sha256(one),
        weights_sha256(random_controller(1)),
        weights_sha256(random_controller(0, last="linear")),
    }
    assert len(hashes) == 3
    assert weights_sha256(Controller(one.layers, {"other": "metadata"})) == weights_sha256(one)


# --- Bad files ---------------------------------------------------------------------------


def changed(change: Callable[[onnx.ModelProto], Any], rays: int = 21) -> bytes:
    model = to_model(random_controller(rays=rays))
    change(model)
    return model.SerializeToString()


def set_weights(model: onnx.ModelProto, index: int, values: np.ndarray) -> None:
    initializer = model.graph.initializer[index]
    initializer.CopyFrom(numpy_helper.from_array(values, initializer.name))


def break_weight(model: onnx.ModelProto, value: float) -> None:
    weights = numpy_helper.to_array(model.graph.initializer[0]).copy()
    weights[0, 3] = value
    set_weights(model, 0, weights)


def narrow_first_layer(model: onnx.ModelProto) -> None:
    set_weights(model, 0, numpy_helper.to_array(model.graph.initializer[0])[:, :20].copy())


def narrow_second_layer(model: onnx.ModelProto) -> None:
    weights = numpy_helper.to_array(model.graph.initializer[2])
    set_weights(model, 2, np.concatenate([weights, weights], axis=1))


def lengthen_biases(model: onnx.ModelProto) -> None:
    biases = numpy_helper.to_array(model.graph.initializer[1])
    set_weights(model, 1, np.append(biases, np.float32(1)))


def upright_biases(model: onnx.ModelProto) -> None:
    set_weights(model, 1, numpy_helper.to_array(model.graph.initializer[1])[:, None].copy())


def second_output(model: onnx.ModelProto) -> None:
    name = model.graph.node[0].output[0]
    value = helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", None])
    model.graph.output.append(value)


def second_input(model: onnx.ModelProto) -> None:
    value = helper.make_tensor_value_info("speed", TensorProto.FLOAT, ["batch", 1])
    model.graph.input.append(value)


def unknown_operator(model: onnx.ModelProto) -> None:
    model.graph.node[1].op_type = "Softplus"


def foreign_operator(model: onnx.ModelProto) -> None:
    model.graph.node[1].domain = "example.org"
    model.opset_import.append(helper.make_opsetid("example.org", 1))


def leading_constant(model: onnx.ModelProto) -> None:
    node = helper.make_node("Constant", [], ["unused"], value_float=1.0)
    model.graph.node.insert(0, node)


def double_precision(model: onnx.ModelProto) -> None:
    for value in (*model.graph.input, *model.graph.output):
        value.type.tensor_type.elem_type = TensorProto.DOUBLE
    for i, initializer in enumerate(model.graph.initializer):
        set_weights(model, i, numpy_helper.to_array(initializer).astype(float))


def double_weights(model: onnx.ModelProto) -> None:
    set_weights(model, 0, numpy_helper.to_array(model.graph.initializer[0]).astype(float))


def fixed_batch(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1


def flat_input(model: onnx.ModelProto) -> None:
    del model.graph.input[0].type.tensor_type.shape.dim[0]


def two_values(model: onnx.ModelProto) -> None:
    for index in (4, 5):
        values = numpy_helper.to_array(model.graph.initializer[index])
        set_weights(model, index, np.concatenate([values, values]))
    model.graph.output[0].type.tensor_type.shape.dim[1].dim_value = 2


def scaled(model: onnx.ModelProto) -> None:
    model.graph.node[0].attribute.append(helper.make_attribute("alpha", 2.0))


def skip_connection(model: onnx.ModelProto) -> None:
    model.graph.node[2].input[0] = "scan"


def two_activations(model: onnx.ModelProto) -> None:
    model.graph.node[1].output[0] = "twice"
    model.graph.node.insert(2, helper.make_node("Tanh", ["twice"], ["layer0.out"]))


def no_layers(model: onnx.ModelProto) -> None:
    del model.graph.node[:]
    del model.graph.initializer[:]
    model.graph.node.append(helper.make_node("Tanh", ["scan"], ["steering"]))


def elsewhere(model: onnx.ModelProto) -> None:
    weights = model.graph.initializer[0]
    weights.ClearField("raw_data")
    weights.data_location = TensorProto.EXTERNAL
    weights.external_data.add(key="location", value="weights.bin")


BAD_FILES: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "not a complete ONNX file"),
    "text": (b"not an ONNX file at all\n", "not a complete ONNX file"),
    "truncated": (changed(lambda _: None)[:-400], "not a complete ONNX file"),
    "half": (changed(lambda _: None)[:300], "not a complete ONNX file"),
    "weights elsewhere": (changed(elsewhere), "with its weights inside"),
    "NaN": (changed(lambda m: break_weight(m, np.nan)), "layer0 holds values that are not finite"),
    "inf": (changed(lambda m: break_weight(m, np.inf)), "layer0 holds values that are not finite"),
    "input width": (changed(narrow_first_layer), "scan has width 21, but the layers have 20"),
    "layer width": (changed(narrow_second_layer), "layer1 does not fit the layer before it"),
    "bias width": (changed(lengthen_biases), "layer0 has biases of shape"),
    "bias shape": (changed(upright_biases), "layer0 has biases of shape"),
    "two outputs": (changed(second_output), "one input and one output; this has 1 and 2"),
    "two inputs": (changed(second_input), "one input and one output; this has 2 and 1"),
    "two values": (changed(two_values), "returns 2 values; a controller returns 1"),
    "operator": (changed(unknown_operator), "operator Softplus is not understood"),
    "foreign": (changed(foreign_operator), "operator Tanh is not understood"),
    "constant": (changed(leading_constant), "operator Constant is not understood"),
    "float64": (changed(double_precision), "layer0 is not float32"),
    "float64 weights": (changed(double_weights), "layer0 is not float32"),
    "fixed batch": (changed(fixed_batch), "scan has a fixed batch of 1"),
    "flat input": (changed(flat_input), "scan is not float32 with shape"),
    "scaled": (changed(scaled), "layer0 scales or transposes"),
    "skip connection": (changed(skip_connection), "not part of one chain"),
    "two activations": (changed(two_activations), "does not follow a Gemm"),
    "no layers": (changed(no_layers), "does not follow a Gemm"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_refused_in_one_line(name: str, tmp_path: Path):
    content, message = BAD_FILES[name]
    path = tmp_path / "bad.onnx"
    path.write_bytes(content)
    for read in (load_controller, runtime_session, RuntimeSteer):
        with pytest.raises(BadInput) as caught:
            read(path)
        assert message in str(caught.value)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path):
    for read in (load_controller, runtime_session, RuntimeSteer):
        with pytest.raises(BadInput, match="No such file"):
            read(tmp_path / "missing.onnx")
        with pytest.raises(BadInput, match="directory"):
            read(tmp_path)


@pytest.mark.parametrize("cut", range(1, 60, 7))
def test_no_truncation_is_taken_for_a_controller(cut: int):
    content = changed(lambda _: None)
    whole = parse_controller(content, "whole")
    try:
        part = parse_controller(content[: len(content) * cut // 60], "part")
    except BadInput:
        return
    assert weights_sha256(part) == weights_sha256(whole)  # only metadata were lost


# --- Writing -----------------------------------------------------------------------------


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "file"
    write_whole(path, b"old")

    def fail(_: Path, __: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_writers_of_one_path_do_not_disturb_each_other(tmp_path: Path):
    path, contents = tmp_path / "file", [bytes([i]) * 100_000 for i in range(8)]
    writers = [threading.Thread(target=write_whole, args=(path, x)) for x in contents]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert path.read_bytes() in contents
    assert list(tmp_path.iterdir()) == [path]

"""Controllers: networks kept in ONNX files.

A controller file takes raw LiDAR distances in metres, float32 ``[batch, rays]``, and
returns the steering angle in radians, float32 ``[batch, 1]``. Normalisation and scaling are
part of its layers. The graph is a chain of Gemm nodes, or of Conv nodes and then Gemm nodes,
each followed by an activation or nothing, so that every verifier can read it.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from racecar.chain import read_chain, write_chain
from racecar.errors import BadInput
from racecar.layers import Layer
from racecar.polygon import Array

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

INPUT, OUTPUT = "scan", "steering"
OPSET, IR_VERSION = 13, 8


@dataclass(frozen=True, eq=False)
class Controller:
    """A controller's layers (raw distances in, steering out) and its file's metadata."""

    layers: tuple[Layer, ...]
    metadata: dict[str, str] = field(default_factory=dict)
    _double: tuple[Layer, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        double = tuple(
            Layer(layer.weights.astype(float), layer.biases.astype(float), layer.activation)
            for layer in self.layers
        )
        object.__setattr__(self, "_double", double)

    @property
    def rays(self) -> int:
        """The number of rays that it reads."""
        return int(self.layers[0].weights.shape[1])

    def steering_rows(self, scan: Array) -> Array:
        """Return the steering angle ``[batch]`` (rad) for a scan ``[rays, batch]`` (m).

        float64 arithmetic on the float32 weights: up to rounding, the real-valued function
        that the network means.
        """
        x = scan
        for layer in self._double:
            x = layer.weights @ x
            x += layer.biases[:, None]
            if layer.activation == "tanh":
                np.tanh(x, out=x)
            elif layer.activation == "relu":
                np.maximum(x, 0, out=x)
            elif layer.activation == "sigmoid":
                x = 0.5 + 0.5 * np.tanh(0.5 * x)  # exp would overflow
        return x[0]

    def steering(self, scan: Array) -> Array:
        """Return the steering angle ``[batch]`` (rad) for a scan ``[batch, rays]`` (m)."""
        return self.steering_rows(np.ascontiguousarray(np.asarray(scan, dtype=float).T))


def to_model(controller: Controller) -> onnx.ModelProto:
    """Return the ONNX model of a controller; the same controller gives the same bytes."""
    nodes, initializers = write_chain(controller.layers, INPUT, OUTPUT)
    graph = helper.make_graph(
        nodes,
        "controller",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["batch", controller.rays])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["batch", 1])],
        initializers,
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="ClosedLap"
    )
    model.ir_version = IR_VERSION
    helper.set_model_props(model, dict(sorted(controller.metadata.items())))
    onnx.checker.check_model(model, full_check=True)
    return model


def save_controller(controller: Controller, path: Path) -> None:
    """Write a controller's ONNX file, whole or not at all."""
    write_whole(path, to_model(controller).SerializeToString(deterministic=True))


def write_whole(path: Path, content: bytes | memoryview) -> None:
    """Write a file so that it is seen complete or not at all, even after a crash.

    Writers of the same path at the same time do not disturb each other: one of them wins.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def load_controller(path: Path) -> Controller:
    """Read the layers of a controller from its ONNX file.

    Raises BadInput if the file is missing, broken, of another shape than a controller's,
    holds values that are not finite, or uses operators that are not understood.
    """
    return parse_controller(_read(path), str(path))


def _read(path: Path) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}); give an ONNX file") from None


def parse_controller(content: bytes, where: str) -> Controller:
    """Read the layers of a controller from the bytes of an ONNX file named ``where``."""
    try:
        model = onnx.load_from_string(content)
        onnx.checker.check_model(model)
        values = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer}
    except Exception:  # protobuf, the checker and NumPy raise their own types
        raise BadInput(
            f"{where}: not a complete ONNX file with its weights inside; "
            "export or download it again"
        ) from None
    graph = model.graph
    inputs = [i for i in graph.input if i.name not in values]
    if len(inputs) != 1 or len(graph.output) != 1:
        raise BadInput(
            f"{where}: a controller has one input and one output; "
            f"this has {len(inputs)} and {len(graph.output)}"
        )
    layers = read_chain(graph, inputs[0], values, where)
    if layers[-1].weights.shape[0] != 1:
        raise BadInput(
            f"{where}: it returns {layers[-1].weights.shape[0]} values; a controller returns 1"
        )
    _check_tensor(inputs[0], layers[0].weights.shape[1], where)
    _check_tensor(graph.output[0], 1, where)
    return Controller(layers, {p.key: p.value for p in model.metadata_props})


def _check_tensor(value: onnx.ValueInfoProto, width: int, where: str) -> None:
    tensor = value.type.tensor_type
    if tensor.elem_type != TensorProto.FLOAT or len(tensor.shape.dim) != 2:
        raise BadInput(f"{where}: {value.name} is not float32 with shape [batch, {width}]")
    batch, given = tensor.shape.dim
    if batch.HasField("dim_value"):
        raise BadInput(
            f"{where}: {value.name} has a fixed batch of {batch.dim_value}; "
            "export it with a free batch dimension"
        )
    if given.HasField("dim_value") and given.dim_value != width:
        raise BadInput(
            f"{where}: {value.name} has width {given.dim_value}, but the layers have {width}"
        )


def runtime_session(path: Path) -> InferenceSession:
    """Open a controller in onnxruntime on one CPU core, as the judges do.

    Raises BadInput where load_controller does, or if onnxruntime refuses the file.
    """
    content = _read(path)
    parse_controller(content, str(path))
    return open_session(content, str(path))


def open_session(content: bytes, where: str) -> InferenceSession:
    """Open any ONNX file's content in onnxruntime on one CPU core; BadInput if it is refused."""
    # Version 1.32 reports to its makers and leaves a file in /tmp, unless told before its import.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime  # noqa: PLC0415 (slow to import, and not always needed)

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises its own types
        reason = str(error).splitlines()[0]
        raise BadInput(f"{where}: onnxruntime cannot run it ({reason})") from None


class RuntimeSteer:
    """A controller in onnxruntime: float32, one CPU core, as the judges run it.

    Called on scans ``[rays, batch]`` (m), it returns steering angles ``[batch]`` (rad), float64.

    Args:
        controller: an ONNX file, or a controller in memory.

    Raises:
        BadInput: where load_controller does, or if onnxruntime refuses the file.
    """

    def __init__(self, controller: Path | str | Controller) -> None:
        if isinstance(controller, Controller):
            self.rays = controller.rays
            self._session = open_session(to_model(controller).SerializeToString(), "controller")
        else:
            content = _read(Path(controller))
            self.rays = parse_controller(content, str(controller)).rays
            self._session = open_session(content, str(controller))
        self._input = self._session.get_inputs()[0].name
        self._kept = threading.local()

    @property
    def cars_at_once(self) -> int:
        """How many cars to steer at a time (see racecar.closed_loop.Steer)."""
        return max(64, 100_000 // self.rays)

    def __call__(self, scan: Array) -> Array:
        """Return the steering ``[batch]`` (rad) for a scan ``[rays, batch]`` (m)."""
        # Fresh memory is slow to touch, so the float32 rows are kept between calls.
        rows: NDArray[np.float32] | None = getattr(self._kept, "rows", None)
        if rows is None or len(rows) < scan.shape[1]:
            rows = self._kept.rows = np.empty((scan.shape[1], self.rays), dtype=np.float32)
        rows = rows[: scan.shape[1]]
        rows[...] = scan.T
        return self._session.run(None, {self._input: rows})[0][:, 0].astype(float)


def weights_sha256(controller: Controller) -> str:
    """Return a hash of layers alone, independent of names and metadata."""
    digest = hashlib.sha256()
    for layer in controller.layers:
        header = {"activation": layer.activation, "shape": layer.weights.shape}
        digest.update(json.dumps(header, sort_keys=True).encode())
        digest.update(layer.weights.astype("<f4").tobytes())
        digest.update(layer.biases.astype("<f4").tobytes())
    return digest.hexdigest()

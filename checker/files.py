"""What the checker reads: a certificate, an instance and its network.

Numbers are IEEE doubles (weights: float32) and mean exactly their values.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import math
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

NAMES = "s", "f", "v", "theta"  # components of the state

_ACTIVATIONS = ("Tanh", "Sigmoid", "Relu")
_SHAPES = ("Reshape", "Unsqueeze", "Flatten")


class Kind(IntEnum):
    """Kinds of rows."""

    ROOT, PART, IMAGE, ADVANCE, GATHERED = range(5)


class GuardKind(IntEnum):
    """Kinds of guards."""

    CROSS, ADVANCE, TURN = range(3)


class Unreadable(Exception):
    """An input is not what it should be; the message is one line."""


class Rejected(Exception):
    """The certificate does not prove what it claims; the message is one line."""


def require(condition: Any, rule: str) -> None:
    """Raise Rejected unless a condition is true."""
    if not condition:
        raise Rejected(rule)


class Row(NamedTuple):
    """A row as in the file: see docs/certificates.md."""

    step: int
    frame: int
    case: int
    parent: int
    kind: int
    guard: int
    elsewhere: bool
    into: int
    centre: NDArray  # [4, 6]
    spread: NDArray  # [4, m, 2]
    radius: NDArray  # [4]
    piece: NDArray  # [1 + m, 2]


class Guard(NamedTuple):
    """A guard as in the file, with the sign that is assumed."""

    kind: int
    ray: int
    obstacle: int
    front: int
    back: int
    positive: bool


@dataclass(frozen=True, eq=False)
class Certificate:
    """Header, rows, guards and cases (missing: ``[cases, rays]``) as in the file."""

    instance_sha256: str
    weights_sha256: str
    margin: float
    lead: int
    symbols: int
    rows: list[Row]
    guards: list[Guard]
    missing: NDArray


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer of the network, ``activation(weights x + biases)``; "" is no activation."""

    weights: NDArray
    biases: NDArray
    activation: str


@dataclass(frozen=True, eq=False)
class Instance:
    """An instance: its JSON as plain data, the hash of it, and the network with its hash."""

    data: dict[str, Any]
    sha256: str
    layers: list[Layer]
    weights_sha256: str


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise Unreadable(f"{path}: cannot be read ({error.strerror})") from None


def read_certificate(path: Path) -> Certificate:
    """Read a certificate; Unreadable if it is not one, or its arrays do not fit together."""
    content = _bytes(path)
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            given, missing = file.attrs, np.asarray(file["cases/missing"][()])
            if (given["format"], given["version"]) != ("closedlap-certificate", "1.0"):
                raise ValueError("it is not of format closedlap-certificate 1.0")
            header = str(given["instance_sha256"]), str(given["weights_sha256"])
            margin, lead, m = float(given["margin"]), int(given["lead"]), int(given["symbols"])
            reals = {"centre": (4, 6), "spread": (4, m, 2), "radius": (4,), "piece": (1 + m, 2)}
            rows = [Row(*row) for row in _columns(file["rows"], Row._fields, reals)]
            guards = [Guard(*guard) for guard in _columns(file["guards"], Guard._fields, {})]
        if not rows or missing.ndim != 2 or missing.dtype != bool or not math.isfinite(margin):
            raise ValueError("it has no rows, no cases, or no margin")
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise Unreadable(f"{path}: not a sound certificate file ({reason})") from None
    return Certificate(*header, margin, lead, m, rows, guards, missing)


def _columns(group: h5py.Group, names: tuple[str, ...], reals: dict[str, Any]) -> Any:
    """Yield entries of some datasets, all reals finite; the others are integers and booleans."""
    columns, count = [], len(group[names[0]])
    for name in names:
        values = np.asarray(group[name][()])
        kinds, shape = ("f", reals[name]) if name in reals else ("iub", ())
        if values.shape != (count, *shape) or values.dtype.kind not in kinds:
            raise ValueError(f"{name} has shape {values.shape} and type {values.dtype}")
        if name in reals and not (values.dtype == np.float64 and np.isfinite(values).all()):
            raise ValueError(f"{name} holds numbers that are not finite doubles")
        columns.append(values if name in reals else values.tolist())
    return zip(*columns, strict=True)


def read_instance(path: Path) -> Instance:
    """Read an instance and its network; Unreadable if one of them is not one."""
    try:
        data = json.loads(_bytes(path), parse_constant=_refuse, object_pairs_hook=_unique)
        if (data["format"], data["version"]) != ("closedlap-instance", "1.0"):
            raise Unreadable(f"{path}: not an instance of format 1.0")
        file, claimed = path.parent / data["controller"]["file"], data["controller"]["sha256"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise Unreadable(f"{path}: not an instance (JSON)") from None
    content = _bytes(file)
    canonical = json.dumps(data, sort_keys=True, separators=(",", ":")).encode()
    hashes = hashlib.sha256(canonical).hexdigest(), hashlib.sha256(content).hexdigest()
    if hashes[1] != claimed:
        raise Unreadable(f"{file}: its sha256 is not the one that {path} names")
    return Instance(data, hashes[0], read_layers(content, file), hashes[1])


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) < len(pairs):
        raise ValueError("a key is given twice")
    return dict(pairs)


def _refuse(text: str) -> float:
    raise ValueError(f"{text} is no number")


def read_layers(content: bytes, file: Path) -> list[Layer]:
    """Read a chain of Gemm and Conv nodes, each followed by an activation or nothing.

    A Conv slides along the last axis, and becomes the matrix that it means.
    """
    try:
        graph = onnx.load_from_string(content).graph
        values = {t.name: numpy_helper.to_array(t) for t in graph.initializer}
        (scan,) = (i for i in graph.input if i.name not in values)
        x, layers = scan.name, list[Layer]()
        # How the values behind the batch are laid out; their order never changes.
        shape = tuple(d.dim_value for d in scan.type.tensor_type.shape.dim)[1:]
        for node in graph.node:
            if node.input[0] != x or node.domain not in {"", "ai.onnx"} or len(node.output) != 1:
                raise ValueError(f"{node.name} is not part of one chain")
            (x,) = node.output
            if node.op_type == "Gemm":
                layers.append(_read_gemm(node, values))
                if len(shape) != 1:
                    raise ValueError(f"{node.name} multiplies values that are not flat")
                shape = layers[-1].biases.shape
            elif node.op_type == "Conv":
                layer, shape = _read_conv(node, values, shape)
                layers.append(layer)
            elif node.op_type in _SHAPES:
                shape = _reshaped(node, values, shape)
            elif node.op_type in _ACTIVATIONS and layers and not layers[-1].activation:
                layers[-1] = Layer(layers[-1].weights, layers[-1].biases, node.op_type)
            else:
                raise ValueError(f"{node.op_type} is not understood")
        shapes = [layer.weights.shape for layer in layers]
        chained = all(a[0] == b[1] for a, b in itertools.pairwise(shapes))
        if (
            not chained
            or shapes[-1][0] != 1
            or len(shape) != 1
            or [o.name for o in graph.output] != [x]
        ):
            raise ValueError("the layers do not fit together")
    except Exception as error:  # protobuf and NumPy raise their own types
        reason = " ".join(str(error).split())
        raise Unreadable(f"{file}: not a controller (ONNX): {reason}") from None
    return layers


def _reshaped(
    node: onnx.NodeProto, values: dict[str, NDArray], shape: tuple[int, ...]
) -> tuple[int, ...]:
    """Return the layout behind a node that changes nothing else."""
    given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    if node.op_type == "Flatten" and given.get("axis", 1) == 1:
        return (math.prod(shape),)
    if node.op_type == "Reshape" and not given.get("allowzero", 0):
        batch, *wanted = values[node.input[1]].tolist()
        if batch in {-1, 0} and min(wanted) > 0 and math.prod(wanted) == math.prod(shape):
            return tuple(wanted)
    if node.op_type == "Unsqueeze":
        axes = values[node.input[1]].tolist()
        # Read as places of the result: only those in the middle, which leave batch and order.
        if len(axes) == 1 and 1 <= axes[0] <= len(shape):
            return (*shape[: axes[0] - 1], 1, *shape[axes[0] - 1 :])
    raise ValueError(f"{node.name} changes the shape in a way that is not understood")


def _read_conv(
    node: onnx.NodeProto, values: dict[str, NDArray], shape: tuple[int, ...]
) -> tuple[Layer, tuple[int, ...]]:
    """Return a convolution along the last axis as a layer, and the layout of its output."""
    given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    kernels = values[node.input[1]]
    channels, *middle, length = shape
    strange = (
        given.get("group", 1) != 1
        or given.get("auto_pad", b"NOTSET") not in {b"NOTSET", b"VALID"}
        or any(given.get("pads", []))
        or any(d != 1 for d in given.get("dilations", []))
        or middle not in ([], [1])
        or kernels.shape[1:-1] != (channels, *middle)
        or not 0 < kernels.shape[-1] <= length
    )
    if strange:
        raise ValueError(f"{node.name} is not a plain convolution along the scan")
    out, width = len(kernels), kernels.shape[-1]
    starts = range(0, length - width + 1, given.get("strides", [1])[-1])
    biased = len(node.input) > 2 and node.input[2]
    biases = values[node.input[2]] if biased else np.zeros(out, np.float32)
    if biases.shape != (out,):
        raise ValueError(f"{node.name} has biases of another shape")
    # Row by row: each output reads one window of each channel.
    weights = np.zeros((out * len(starts), channels * length), np.float32)
    for o in range(out):
        for p, start in enumerate(starts):
            for c in range(channels):
                first = c * length + start
                row = kernels[o, c].reshape(-1)
                weights[o * len(starts) + p, first : first + width] = row
    if not all(x.dtype == np.float32 and np.isfinite(x).all() for x in (kernels, biases)):
        raise ValueError(f"{node.name} has weights that are not finite floats of 32 bits")
    layer = Layer(weights, np.repeat(biases, len(starts)), "")
    return layer, (out, *middle, len(starts))


def _read_gemm(node: onnx.NodeProto, values: dict[str, NDArray]) -> Layer:
    given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    if given.get("alpha", 1.0) != 1.0 or given.get("beta", 1.0) != 1.0 or given.get("transA", 0):
        raise ValueError(f"{node.name} scales or transposes its input")
    weights = values[node.input[1]] if given.get("transB", 0) else values[node.input[1]].T
    biased = len(node.input) > 2 and node.input[2]
    biases = values[node.input[2]].reshape(-1) if biased else np.zeros(len(weights), np.float32)
    if weights.ndim != 2 or biases.shape != weights.shape[:1]:
        raise ValueError(f"{node.name} has weights of another shape")
    if not all(x.dtype == np.float32 and np.isfinite(x).all() for x in (weights, biases)):
        raise ValueError(f"{node.name} has weights that are not finite floats of 32 bits")
    return Layer(weights, biases, "")

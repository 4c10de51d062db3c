"""What is read: a certificate that divides boxes, a VNN-LIB question, and an ONNX network."""

from __future__ import annotations

import gzip
import hashlib
import io
import zlib
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from checker.files import Unreadable, read_layers
from checker.query.chain import Chain
from checker.query.graph import Graph
from checker.query.vnnlib import Question, read_question

FORMAT, VERSION = "closedlap-query-certificate", "1.0"
#: More bytes are not unpacked.
_LARGEST = 1 << 30
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Certificate:
    """As in the file.

    lower, upper: of boxes, ``[boxes, inputs]``; dim, at: of all nodes of all trees, one after the
    other, each in preorder; dim -1: a leaf.
    """

    onnx_sha256: str
    spec_sha256: str
    lower: Array
    upper: Array
    dim: list[int]
    at: list[float]


@dataclass(frozen=True, eq=False)
class Asked:
    """A question and the network that it is about, with the hashes of the unpacked files."""

    question: Question
    spec_sha256: str
    network: Chain | Graph
    onnx_sha256: str


def read_certificate(path: Path) -> Certificate:
    """Read a certificate; Unreadable if it is not one, or its arrays do not fit together."""
    content = _bytes(path)
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            given = file.attrs
            if (given["format"], given["version"]) != (FORMAT, VERSION):
                raise ValueError(f"it is not of format {FORMAT} {VERSION}")
            hashes = str(given["onnx_sha256"]), str(given["spec_sha256"])
            names = "boxes/lower", "boxes/upper", "nodes/dim", "nodes/at"
            lower, upper, dim, at = (np.asarray(file[name][()]) for name in names)
        for array in (lower, upper, at):
            if array.dtype != np.float64 or not np.isfinite(array).all():
                raise ValueError("it holds numbers that are not finite doubles")
        fitting = lower.ndim == 2 and lower.shape == upper.shape and at.shape == dim.shape
        if not fitting or dim.ndim != 1 or dim.dtype.kind not in "iu":
            raise ValueError("its arrays do not fit together")
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise Unreadable(f"{path}: not a sound certificate file ({reason})") from None
    return Certificate(*hashes, lower, upper, dim.tolist(), at.tolist())


def read_asked(spec: Path, onnx: Path) -> Asked:
    """Read a question and its network, gzipped or not; Unreadable if one of them is not one."""
    text, model = _bytes(spec), _bytes(onnx)
    try:
        question = read_question(text.decode("utf-8"), str(spec))
    except UnicodeDecodeError:
        raise Unreadable(f"{spec}: it is not text") from None
    try:
        network: Chain | Graph = Chain(read_layers(model, onnx))
    except Unreadable:
        network = Graph(model, str(onnx))
    sizes = question.inputs, question.outputs
    if sizes != (network.inputs, network.outputs):
        raise Unreadable(
            f"{spec}: it declares {sizes[0]} inputs and {sizes[1]} outputs; {onnx} has "
            f"{network.inputs} and {network.outputs}"
        )
    return Asked(question, _sha256(text), network, _sha256(model))


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _bytes(path: Path) -> bytes:
    """Return the content of a file, unpacked if it is gzipped."""
    try:
        content = path.read_bytes()
        if content.startswith(b"\x1f\x8b"):
            with gzip.open(io.BytesIO(content)) as file:
                content = file.read(_LARGEST + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise Unreadable(f"{path}: cannot be read ({error})") from None
    if len(content) > _LARGEST:
        raise Unreadable(f"{path}: unpacked it is larger than {_LARGEST >> 20} MiB")
    return content

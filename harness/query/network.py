"""Run the network that a query is about: onnxruntime, CPU, one thread, in the file's own types."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from harness.given import Malformed
from harness.query.read import NotUnderstood, Query
from harness.query.terms import Tensor
from racecar.controller import open_session
from racecar.errors import BadInput

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

#: More bytes are not read from a network or a query, packed or not.
LARGEST_FILE = 1 << 30
_GZIP = b"\x1f\x8b"
_DTYPES: dict[str, type] = {"tensor(float)": np.float32, "tensor(double)": np.float64}
_DECLARED = {"float32": "tensor(float)", "float64": "tensor(double)"}


class CannotRun(Exception):
    """The network cannot be run on these inputs; the message says why."""


def unpack(content: bytes, where: str) -> bytes:
    """Return the content of a file that may be gzipped; BadInput if it is broken or huge."""
    if not content.startswith(_GZIP):
        return content
    try:
        with gzip.open(BytesIO(content)) as file:
            unpacked = file.read(LARGEST_FILE + 1)
    except (OSError, EOFError, zlib.error):
        raise BadInput(f"{where}: it is not a complete gzip file") from None
    if len(unpacked) > LARGEST_FILE:
        raise BadInput(f"{where}: unpacked it is larger than {LARGEST_FILE >> 20} MiB")
    return unpacked


class Network:
    """A network with the inputs and outputs that a query declares.

    Raises BadInput if onnxruntime refuses the file, or if it and the query do not fit together.
    """

    def __init__(self, content: bytes, query: Query, where: str) -> None:
        self._session = _open(content, where)
        self._tensors = query.inputs, query.outputs
        self._where = where
        files = self._session.get_inputs(), self._session.get_outputs()
        for kind, tensors, found in zip(("inputs", "outputs"), self._tensors, files, strict=True):
            if len(tensors) != len(found):
                counts = f"{len(tensors)} {kind}, the network has {len(found)}"
                raise BadInput(f"{where}: the query declares {counts}")
            for tensor, value in zip(tensors, found, strict=True):
                self._check(tensor, value)

    def _check(self, tensor: Tensor, value: Any) -> None:
        if value.type not in _DTYPES:
            raise NotUnderstood(f"{self._where}: {value.name} is a {value.type}")
        if _DECLARED.get(tensor.dtype, value.type) != value.type:
            raise BadInput(
                f"{self._where}: {value.name} is a {value.type}, but {tensor.name} is declared "
                f"as {tensor.dtype}"
            )
        size = math.prod(_shape(value.shape))
        if size != tensor.size:
            raise BadInput(
                f"{self._where}: {value.name} has {size} elements, but {tensor.name} is declared "
                f"with {tensor.size}"
            )

    def feed(self, values: Sequence[NDArray[np.float64]]) -> list[NDArray[Any]]:
        """Return the inputs as the network gets them; Malformed if one is too large for its type.

        values: of each input, ``[size]``.
        """
        fed: list[NDArray[Any]] = []
        for given, value in zip(values, self._session.get_inputs(), strict=True):
            with np.errstate(over="ignore"):
                cast: NDArray[Any] = given.astype(_DTYPES[value.type])
            if not np.isfinite(cast).all():
                raise Malformed(f"a value is too large for a {value.type}")
            fed.append(cast.reshape(_shape(value.shape)))
        return fed

    def run(self, fed: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
        """Return the outputs for what ``feed`` returned; CannotRun if onnxruntime gives up."""
        names = [value.name for value in self._session.get_inputs()]
        try:
            outputs = self._session.run(None, dict(zip(names, fed, strict=True)))
        except Exception as error:  # onnxruntime raises its own types
            raise CannotRun(str(error).splitlines()[0]) from None
        for tensor, output in zip(self._tensors[1], outputs, strict=True):
            if output.size != tensor.size:
                raise CannotRun(f"{tensor.name} came out with {output.size} elements")
        return outputs


@lru_cache(maxsize=8)
def _open(content: bytes, where: str) -> InferenceSession:
    return open_session(content, where)


def exact(tensors: Sequence[NDArray[Any]]) -> list[list[Fraction]]:
    """Return the elements of tensors, row-major, as fractions; they must be finite."""
    return [[Fraction(x) for x in tensor.ravel().tolist()] for tensor in tensors]


def read_unpacked(path: Path) -> bytes:
    """Return a file's content, unpacked if it is gzipped; BadInput if it cannot be read."""
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
    if len(content) > LARGEST_FILE:
        raise BadInput(f"{path}: it is larger than {LARGEST_FILE >> 20} MiB")
    return unpack(content, str(path))


def _shape(shape: Sequence[int | str | None]) -> tuple[int, ...]:
    """Return a shape with 1 for every dimension that is left open."""
    return tuple(size if isinstance(size, int) and size > 0 else 1 for size in shape)

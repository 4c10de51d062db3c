"""Write a counterexample in the two syntaxes of VNN-LIB, for tools that print another form.

1.0: one s-expression, ``((X_0 v) ... (Y_0 v) ...)``. 2.0: per tensor in the order of declaration
``NAME type [shape]``, then one value a line, row-major.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from racecar.errors import BadInput

_VERSION = re.compile(r"\(\s*vnnlib-version\s*<\s*2\.0\s*>\s*\)")
_TENSOR = re.compile(r"\(\s*declare-(input|output)\s+(\S+)\s+(\S+)\s+\[([\d,\s]*)\]")
_COMMENT = re.compile(r";.*")


@dataclass(frozen=True)
class Tensor:
    """A tensor that a 2.0 specification declares; of one network each."""

    kind: str
    name: str
    type: str
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many values it has."""
        return math.prod(self.shape)


def is_version_2(spec: str) -> bool:
    """Whether the text of a specification is VNN-LIB 2.0."""
    return _VERSION.search(_COMMENT.sub("", spec)) is not None


def declared_tensors(spec: str) -> list[Tensor]:
    """Return the tensors of a 2.0 specification in order."""
    return [
        Tensor(kind, name, type_, tuple(int(n) for n in shape.split(",") if n.strip()))
        for kind, name, type_, shape in _TENSOR.findall(_COMMENT.sub("", spec))
    ]


def network_outputs(onnx: Path, inputs: Sequence[float]) -> list[float]:
    """Return the outputs for flat inputs, by onnxruntime on one core of the CPU."""
    import numpy as np  # noqa: PLC0415
    from onnxruntime import InferenceSession, SessionOptions  # noqa: PLC0415

    options = SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session: Any = InferenceSession(str(onnx), options, providers=["CPUExecutionProvider"])
    given = session.get_inputs()[0]
    shape = [n if isinstance(n, int) and n > 0 else 1 for n in given.shape]
    if math.prod(shape) != len(inputs):
        raise BadInput(f"{onnx}: it takes {math.prod(shape)} inputs, the witness has {len(inputs)}")
    kind = np.float64 if given.type == "tensor(double)" else np.float32
    values = np.array(inputs, kind).reshape(shape)
    return [float(y) for y in session.run(None, {given.name: values})[0].ravel()]


def write_counterexample(spec: str, inputs: Sequence[float], outputs: Sequence[float]) -> str:
    """Return a counterexample in the syntax of the specification's version.

    spec: its text; inputs, outputs: of the network, flat. BadInput if a 2.0 specification
    declares another number of them, or more than one network.
    """
    if not is_version_2(spec):
        return "\n".join(_pairs(inputs, outputs)) + "\n"
    tensors = declared_tensors(spec)
    if [tensor.kind for tensor in tensors] != ["input", "output"]:
        raise BadInput("the specification does not declare one input and one output")
    lines = []
    for tensor, values in zip(tensors, (inputs, outputs), strict=True):
        if tensor.size != len(values):
            raise BadInput(f"{tensor.name} has {tensor.size} values, the witness {len(values)}")
        shape = ",".join(str(n) for n in tensor.shape)
        lines += [f"{tensor.name} {tensor.type} [{shape}]", *(repr(float(x)) for x in values)]
    return "\n".join(lines) + "\n"


def _pairs(inputs: Sequence[float], outputs: Sequence[float]) -> Iterator[str]:
    pairs = [f"(X_{i} {float(x)!r})" for i, x in enumerate(inputs)]
    pairs += [f"(Y_{i} {float(y)!r})" for i, y in enumerate(outputs)]
    last = len(pairs) - 1
    for i, pair in enumerate(pairs):
        yield ("(" if i == 0 else "") + pair + (")" if i == last else "")

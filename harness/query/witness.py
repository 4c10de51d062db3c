"""The counterexamples that VNN-COMP 2026 asks for after ``sat``.

Version 1.0: one s-expression, ``((X_0 0.5) (X_1 1.0) ... (Y_0 -0.2))``. Version 2.0: for every
tensor in the order of declaration a line ``NAME dtype [dims]``, then one value a line, row-major.
What is said of the outputs is not used.
"""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from harness.given import Malformed
from harness.query.read import whole_numbers
from harness.query.terms import Query, Tensor

_PAIR = re.compile(r"\(\s*([XY])_(\d{1,9})\s+([^\s()]+)\s*\)\s*")
_HEADER = re.compile(r"(\S+)\s+(\S+)\s+\[([^\[\]]*)\]")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_LONGEST_NUMBER = 2000


def read_inputs(text: bytes, query: Query) -> list[NDArray[np.float64]]:
    """Return the values of the inputs in a witness, ``[size]`` each, in the order of the query.

    Raises Malformed if the witness has not the form that the query's version asks for.
    """
    try:
        content = text.decode("utf-8")
    except UnicodeDecodeError:
        raise Malformed("it is not text") from None
    read = _read_1 if query.version == "1.0" else _read_2
    return [np.array(values) for values in read(content, query)]


def _read_1(content: str, query: Query) -> list[list[float]]:
    content = content.strip()
    if not content.startswith("(") or not content.endswith(")"):
        raise Malformed("it is not one s-expression ((X_0 ...) ... (Y_0 ...))")
    inner = content[1:-1].lstrip()
    given: dict[str, list[float]] = {"X": [], "Y": []}
    position = 0
    while position < len(inner):
        match = _PAIR.match(inner, position)
        if match is None:
            raise Malformed(f"{_short(inner[position:])} is not (X_i number) or (Y_i number)")
        name, index, number = match.groups()
        if int(index) != len(given[name]):
            raise Malformed(f"{name}_{index} stands where {name}_{len(given[name])} must be")
        given[name].append(_number(number, f"{name}_{index}") if name == "X" else 0.0)
        position = match.end()
    (wanted,) = query.inputs
    if len(given["X"]) != wanted.size:
        raise Malformed(f"it gives {len(given['X'])} inputs; there are {wanted.size}")
    return [given["X"]]


def _read_2(content: str, query: Query) -> list[list[float]]:
    lines = [line.strip() for line in content.splitlines() if line.strip()]
    position, values = 0, []
    for tensor in query.tensors:
        if position >= len(lines):
            raise Malformed(f"{tensor.name} is missing")
        _check_header(lines[position], tensor)
        rows = lines[position + 1 : position + 1 + tensor.size]
        if len(rows) < tensor.size:
            raise Malformed(f"{tensor.name} has {len(rows)} values; it must have {tensor.size}")
        if tensor.is_input:
            values.append([_number(row, f"{tensor.name}, value {i}") for i, row in enumerate(rows)])
        position += 1 + tensor.size
    if position < len(lines):
        raise Malformed(f"{_short(lines[position])} follows the last value")
    return values


def _check_header(line: str, tensor: Tensor) -> None:
    wanted = f"{tensor.name} {tensor.dtype} {list(tensor.shape)}"
    match = _HEADER.fullmatch(line)
    # As in VNN-COMP every tensor may be called real.
    if (
        match is None
        or match[1] != tensor.name
        or match[2].lower() not in (tensor.dtype, "real")
        or whole_numbers(match[3]) != tensor.shape
    ):
        raise Malformed(f"{_short(line)} stands where {wanted} must be")


def _number(text: str, what: str) -> float:
    value = float(text) if _is_number(text) else math.nan
    if not math.isfinite(value):
        raise Malformed(f"{what}: {_short(text)} is not a finite number")
    return value


def _is_number(text: str) -> bool:
    return len(text) <= _LONGEST_NUMBER and _NUMBER.fullmatch(text) is not None


def _short(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:40] + "...")

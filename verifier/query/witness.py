"""Counterexamples as VNN-COMP asks for them, in the version that the question is written in."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from harness.query.terms import Query, Tensor


def write_witness(query: Query, inputs: NDArray[np.float32], outputs: NDArray[np.float64]) -> str:
    """Return the text that follows ``sat``; inputs and outputs flat, numbers exact."""
    # A float32 as a double: 17 digits give it exactly.
    values = [repr(float(x)) for x in inputs], [repr(float(y)) for y in outputs]
    if query.version == "1.0":
        pairs = [f"(X_{i} {x})" for i, x in enumerate(values[0])]
        pairs += [f"(Y_{i} {y})" for i, y in enumerate(values[1])]
        return "(" + "\n ".join(pairs) + ")\n"
    sides = iter(values[0]), iter(values[1])
    lines = [
        line for tensor in query.tensors for line in _tensor(tensor, sides[not tensor.is_input])
    ]
    return "\n".join(lines) + "\n"


def _tensor(tensor: Tensor, values: Iterable[str]) -> list[str]:
    head = f"{tensor.name} {tensor.dtype} [{','.join(map(str, tensor.shape))}]"
    return [head, *(value for value, _ in zip(values, range(tensor.size), strict=False))]

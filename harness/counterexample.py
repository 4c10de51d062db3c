"""Write a counterexample in the two syntaxes of VNN-LIB, for tools that print another form.

1.0: one s-expression, ``((X_0 v) ... (Y_0 v) ...)``. 2.0: per tensor in the order of declaration
``NAME type [shape]``, then one value a line, row-major.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from harness.given import Malformed
from harness.query.network import CannotRun, Network, read_unpacked
from harness.query.read import NotUnderstood, read_query
from harness.query.terms import Query
from racecar.errors import BadInput


def counterexample_for(onnx: Path, spec: Path, inputs: Sequence[float]) -> str:
    """Return the counterexample with these inputs, flat, and the outputs that onnxruntime gives.

    BadInput if there is another number of inputs, or if the network cannot be run on them.
    """
    try:
        query = read_query(read_unpacked(spec).decode("utf-8"), str(spec))
        _check_count(query, inputs)
        network = Network(read_unpacked(onnx), query, str(onnx))
        (outputs,) = network.run(network.feed([np.array(inputs)]))
    except (NotUnderstood, Malformed, CannotRun) as error:
        raise BadInput(f"{spec}: {error}") from None
    return write_counterexample(query, inputs, outputs.ravel().tolist())


def write_counterexample(query: Query, inputs: Sequence[float], outputs: Sequence[float]) -> str:
    """Return a counterexample in the syntax of the query's version.

    inputs, outputs: of a network with one tensor of each, flat.
    """
    if query.version == "1.0":
        return "\n".join(_pairs(inputs, outputs)) + "\n"
    lines = []
    for tensor in query.tensors:
        shape = ",".join(str(size) for size in tensor.shape)
        lines.append(f"{tensor.name} {tensor.dtype} [{shape}]")
        lines += [repr(float(x)) for x in (inputs if tensor.is_input else outputs)]
    return "\n".join(lines) + "\n"


def _check_count(query: Query, inputs: Sequence[float]) -> None:
    if len(query.inputs) != 1 or len(query.outputs) != 1:
        raise NotUnderstood("it does not declare one input and one output")
    if query.inputs[0].size != len(inputs):
        wanted = query.inputs[0].size
        raise BadInput(f"the network takes {wanted} inputs, the witness has {len(inputs)}")


def _pairs(inputs: Sequence[float], outputs: Sequence[float]) -> Iterator[str]:
    pairs = [f"(X_{i} {float(x)!r})" for i, x in enumerate(inputs)]
    pairs += [f"(Y_{i} {float(y)!r})" for i, y in enumerate(outputs)]
    last = len(pairs) - 1
    for i, pair in enumerate(pairs):
        yield ("(" if i == 0 else "") + pair + (")" if i == last else "")

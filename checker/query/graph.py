"""Any ONNX graph of some arithmetic on the checker's models (Arb balls): for unrolled loops.

Every tensor is one row ``[1, n]``: a batch of 1. One uncertain input becomes x of the models, the
others a symbol each; see checker.models for what a model is and stands for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
from flint import arb, arb_mat
from numpy.typing import NDArray
from onnx import numpy_helper

from checker import models
from checker.files import Unreadable
from checker.models import BASE, KNOWN, TERMS, ZERO, Model, bound, plus, scale
from checker.query import elements
from checker.query.elements import Known

Array = NDArray[np.float64]
#: A tensor: models, one for each element, or for comparisons True, False or None (not known).
Values = list[Any]
#: A box is divided into cases at so many open comparisons, one after the other.
_DIVIDED = 3


class Graph:
    """The real-valued function of an ONNX graph and its float32 constants."""

    def __init__(self, content: bytes, where: str) -> None:
        try:
            graph = onnx.load_from_string(content).graph
            self._constants = {t.name: _exact(t) for t in graph.initializer}
            (given,) = (i for i in graph.input if i.name not in self._constants)
            (asked,) = graph.output
            self._input, self._output = given.name, asked.name
            self.inputs, self.outputs = _row(given), _row(asked)
            self._steps = [_step(node, self._constants) for node in graph.node]
            known = {given.name, *self._constants}
            for _, sources, target in self._steps:
                if not known.issuperset(sources) or target in known:
                    raise ValueError(f"{target} is made of what is not there yet, or is made twice")
                known.add(target)
            if asked.name not in known:
                raise ValueError("nothing makes the output")
        except Exception as error:  # protobuf and NumPy raise their own types
            reason = " ".join(str(error).split())
            raise Unreadable(f"{where}: not a network that is known here: {reason}") from None
        self._last = {name: k for k, step in enumerate(self._steps) for name in step[1]}
        self._matrices: dict[int, arb_mat] = {}

    def least(self, lower: Array, upper: Array, factors: Array) -> Array:
        """Return lower bounds ``[boxes, sums]`` of sums of multiples of the outputs.

        lower, upper: of boxes, ``[boxes, inputs]``; factors: ``[sums, outputs]``; NaN: no bound.
        """
        found = np.full((len(lower), len(factors)), np.nan)
        for k, (low, high) in enumerate(zip(lower, upper, strict=True)):
            try:
                cases = self.values(low, high)
            except (ArithmeticError, TypeError, ValueError):
                continue  # not defined there, or the tensors do not fit together
            found[k] = np.min([[_least(case, row) for row in factors] for case in cases], axis=0)
        return found

    def values(self, lower: Array, upper: Array) -> list[list[Model]]:
        """Return models of the outputs on a box: in every case that it is divided into.

        Where it is open how a comparison of one element with a number ends, both are followed.
        ArithmeticError if something is not defined everywhere.
        """
        first: dict[str, Values] = {self._input: _inputs(lower, upper)}
        m = models.symbols(first[self._input][0])
        numbers = {
            name: [models.constant(arb(float(x)), m) for x in array.ravel()]
            for name, array in self._constants.items()
            if array.size == _last_axis(array)
        }
        todo, found = [(0, first, 0)], []
        while todo:
            start, values, divided = todo.pop()
            for k in range(start, len(self._steps)):
                apply, sources, target = self._steps[k]
                given = [values[s] if s in values else numbers.get(s, []) for s in sources]
                values[target] = apply(self, given)
                if values[target] == [None] and divided < _DIVIDED and sources[1] in numbers:
                    for sign in (False, True):
                        case = _assumed(values, sources[0], given[1][0], sign)
                        todo.append((k + 1, {**case, target: [sign]}, divided + 1))
                    break
                for source in sources:  # what is not needed any more
                    if self._last[source] == k and source != self._output:
                        values.pop(source, None)
            else:
                found.append(values[self._output])
        return found

    def matrix(self, weights: NDArray[np.float64]) -> arb_mat:
        """Return weights ``[out, in]`` as a matrix, made once."""
        if id(weights) not in self._matrices:
            self._matrices[id(weights)] = arb_mat(weights.tolist())
        return self._matrices[id(weights)]


def _least(outputs: list[Model], factors: Array) -> float:
    """Return a lower bound of a sum of multiples of outputs; NaN if there is none."""
    total, apart = models.constant(ZERO, models.symbols(outputs[0])), ZERO
    for output, factor in zip(outputs, map(arb, factors.tolist()), strict=True):
        if factor != 0:
            total = models.add(total, scale(output, factor))
            apart += factor * elements.interval(output)[0 if factor > 0 else 1]
    least = max((x.lower() for x in (bound(total), apart) if x.is_finite()), default=apart)
    return float(np.nextafter(float(least), -np.inf)) if least.is_finite() else np.nan


def _assumed(values: dict[str, Values], name: str, number: Model, sign: bool) -> dict[str, Values]:
    """Return values where one is known to be at least, or at most, a number."""
    if name not in values:
        return dict(values)
    (z,) = values[name]
    low, high = elements.interval(z)
    end = number[0]
    low, high = (low.max(end), high) if sign else (low, high.min(end))
    parts = (z.above, z.below) if isinstance(z, Known) else (None, None)
    return {**values, name: [Known(z, low, high, *parts)]}


#: What makes a tensor: the function, the names that it takes, and the name of its result.
_Step = tuple[Callable[[Graph, list[Values]], Values], list[str], str]


def _exact(tensor: onnx.TensorProto) -> NDArray[np.float64]:
    array = numpy_helper.to_array(tensor)
    if array.dtype not in (np.float32, np.float64) or not np.isfinite(array).all():
        raise ValueError(f"{tensor.name} holds what are no finite floats")
    return np.ascontiguousarray(array, dtype=np.float64)


def _row(value: onnx.ValueInfoProto) -> int:
    shape = [d.dim_value for d in value.type.tensor_type.shape.dim]
    if len(shape) != 2 or shape[0] > 1 or shape[1] < 1:
        raise ValueError(f"{value.name} is not one row")
    return shape[1]


def _inputs(lower: Array, upper: Array) -> list[Model]:
    """Return models of the inputs on a box: the widest one runs along x, others along symbols.

    Up to BASE of these are such whose products are known. Where there are none, nothing else is.
    """
    uncertain = [int(i) for i in np.argsort(lower - upper, kind="stable") if lower[i] < upper[i]]
    others = uncertain[1:]
    places = [*range(BASE), *range(KNOWN, KNOWN + len(others))]
    m = max(KNOWN, KNOWN + len(others) - BASE) if others else 0
    found = []
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        middle, half = (arb(low) + arb(high)) / 2, (arb(high) - arb(low)) / 2
        model = models.constant(middle, m)
        if uncertain and i == uncertain[0]:
            model[1] = half
        elif i in others:
            model[TERMS + places[others.index(i)]] = half
        found.append(model)
    return found


def _step(node: onnx.NodeProto, constants: dict[str, NDArray[np.float64]]) -> _Step:
    if node.domain not in {"", "ai.onnx"} or len(node.output) != 1:
        raise ValueError(f"{node.name or node.op_type} is not known")
    given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    kind, sources = node.op_type, list(node.input)
    if kind in ("Gemm", "MatMul"):
        return _affine(node, given, constants)
    given_numbers = [constants[s] for s in sources if s in constants]
    wide = any(x.ndim > 2 or x.size != _last_axis(x) for x in given_numbers)
    if wide or kind not in _OPERATORS or (given and kind != "Concat"):
        raise ValueError(f"{kind} is not known, or not of such operands")
    if kind == "Concat" and given.get("axis") not in (1, -1):
        raise ValueError("Concat is not along the row")
    count, apply = _OPERATORS[kind]
    if count is not None and len(sources) != count:
        raise ValueError(f"{kind} of {len(sources)} operands")
    return (lambda graph, values: apply(values)), sources, node.output[0]


def _last_axis(array: NDArray[np.float64]) -> int:
    return array.shape[-1] if array.ndim else 1


def _affine(
    node: onnx.NodeProto, given: dict[str, Any], constants: dict[str, NDArray[np.float64]]
) -> _Step:
    """Return a product with a matrix, and a bias."""
    source, matrix, *more = node.input
    if set(given) - {"alpha", "beta", "transA", "transB"} or given.get("transA", 0):
        raise ValueError(f"{node.name or node.op_type} is not a plain product")
    if given.get("alpha", 1.0) != 1.0 or given.get("beta", 1.0) != 1.0 or source in constants:
        raise ValueError(f"{node.name or node.op_type} scales, or multiplies constants")
    weights = constants[matrix] if given.get("transB", 0) else constants[matrix].T
    bias = constants[more[0]].ravel() if more and more[0] else np.zeros(len(weights))
    if weights.ndim != 2 or bias.size not in (1, len(weights)):
        raise ValueError(f"{node.name or node.op_type} has weights of another shape")
    shifts = [arb(float(b)) for b in np.broadcast_to(bias, len(weights))]

    def apply(graph: Graph, values: list[Values]) -> Values:
        if len(values[0]) != weights.shape[1]:
            raise ArithmeticError("a product does not fit")
        rows = (graph.matrix(weights) * arb_mat(values[0])).tolist()
        if not bias.any() and all(_is_quotient(z, values[0][0]) for z in values[0]):
            above = (graph.matrix(weights) * arb_mat([z.above for z in values[0]])).tolist()
            return [_over(row, up, values[0][0].below) for row, up in zip(rows, above, strict=True)]
        return [plus(row, shift) for row, shift in zip(rows, shifts, strict=True)]

    return apply, [source], node.output[0]


def _is_quotient(z: Model, first: Model) -> bool:
    """Tell whether both are quotients by the same number."""
    if not (isinstance(z, Known) and isinstance(first, Known)):
        return False
    return z.below is not None and z.below is first.below


def _over(row: Model, above: Model, below: Model) -> Model:
    """Return a sum of quotients by the same number, of which both forms are known."""
    ends = elements.divided(elements.interval(above), elements.interval(below))
    return Known(row, *ends, above=above, below=below)


def _elementwise(function: Callable[..., Any]) -> Callable[[list[Values]], Values]:
    def apply(operands: list[Values]) -> Values:
        count = max(map(len, operands))
        spread = [v * count if len(v) == 1 else v for v in operands]
        return [function(*elements) for elements in zip(*spread, strict=True)]

    return apply


def _folded(function: Callable[[Model, Model], Model]) -> Callable[[list[Values]], Values]:
    def apply(operands: list[Values]) -> Values:
        first, *others = operands
        for other in others:
            first = _elementwise(function)([first, other])
        return first

    return apply


def _joined(operands: list[Values]) -> Values:
    return [element for operand in operands for element in operand]


def _quotients(operands: list[Values]) -> Values:
    above, below = operands
    inverse = [elements.reciprocal(z) for z in below]
    return _elementwise(elements.quotient)([above, below, inverse])


#: How many operands, None: any number; what they become.
_OPERATORS: dict[str, tuple[int | None, Callable[[list[Values]], Values]]] = {
    "Add": (2, _elementwise(models.add)),
    "Sub": (2, _elementwise(models.subtract)),
    "Mul": (2, _elementwise(elements.product)),
    "Div": (2, _quotients),
    "Neg": (1, _elementwise(elements.negative)),
    "Tanh": (1, _elementwise(elements.tanh)),
    "Sigmoid": (1, _elementwise(elements.sigmoid)),
    "Relu": (1, _elementwise(models.relu)),
    "Sin": (1, _elementwise(models.sine)),
    "Cos": (1, _elementwise(models.cosine)),
    "Max": (None, _folded(elements.maximum)),
    "Min": (None, _folded(elements.minimum)),
    "Concat": (None, _joined),
    "Greater": (2, _elementwise(elements.greater)),
    "GreaterOrEqual": (2, _elementwise(elements.at_least)),
    "Where": (3, _elementwise(elements.chosen)),
}

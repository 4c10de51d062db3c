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
from checker.models import BASE, HALF, KNOWN, TERMS, UNIT, ZERO, Model, bound, plus, scale

Array = NDArray[np.float64]
#: A tensor: models, one for each element, or for comparisons True, False or None (not known).
Values = list[Any]


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
                outputs = self.values(low, high)
            except (ArithmeticError, TypeError, ValueError):
                continue  # not defined there, or the tensors do not fit together
            for i, row in enumerate(factors):
                total = models.constant(ZERO, models.symbols(outputs[0]))
                for output, factor in zip(outputs, row, strict=True):
                    if factor:
                        total = models.add(total, scale(output, arb(float(factor))))
                least = bound(total).lower()
                if least.is_finite():
                    found[k, i] = np.nextafter(float(least), -np.inf)
        return found

    def values(self, lower: Array, upper: Array) -> list[Model]:
        """Return models of the outputs on a box; ArithmeticError if one is not defined there."""
        values: dict[str, Values] = {self._input: _inputs(lower, upper)}
        m = models.symbols(values[self._input][0])
        numbers = {
            name: [models.constant(arb(float(x)), m) for x in array.ravel()]
            for name, array in self._constants.items()
            if array.size == _last_axis(array)
        }
        for k, (apply, sources, target) in enumerate(self._steps):
            given = [values[s] if s in values else numbers.get(s, []) for s in sources]
            values[target] = apply(self, given)
            for source in sources:  # what is not needed any more
                if self._last[source] == k and source != self._output:
                    values.pop(source, None)
        return values[self._output]

    def matrix(self, weights: NDArray[np.float64]) -> arb_mat:
        """Return weights ``[out, in]`` as a matrix, made once."""
        if id(weights) not in self._matrices:
            self._matrices[id(weights)] = arb_mat(weights.tolist())
        return self._matrices[id(weights)]


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
        return [plus(row, shift) for row, shift in zip(rows, shifts, strict=True)]

    return apply, [source], node.output[0]


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


def _is_number(z: Model) -> bool:
    return all(x == 0 for x in z[1:])


class _Limited(list[arb]):
    """A model, and a number that its values do not come below (sign 1) or above (sign -1)."""

    def __init__(self, z: Model, limit: arb, sign: int) -> None:
        super().__init__(z)
        self.limit, self.sign = limit, sign


def _maximum(z: Model, w: Model) -> Model:
    return _Limited(models.maximum(z, w), bound(z).lower().max(bound(w).lower()), 1)


def _minimum(z: Model, w: Model) -> Model:
    return _Limited(models.minimum(z, w), bound(z).upper().min(bound(w).upper()), -1)


def _reciprocal(z: Model) -> Model:
    """Return 1 / z; ArithmeticError unless z is known not to be 0."""
    if _is_number(z):
        return models.constant(1 / z[0], models.symbols(z))
    if isinstance(z, _Limited) and z.sign * z.limit > 0:
        if z.sign > 0:
            return models.inverse_from(list(z), z.limit)
        return models.negative(models.inverse_from(models.negative(z), -z.limit))
    return models.reciprocal(z)


def _tanh(z: Model) -> Model:
    """Return the hyperbolic tangent, by lines where its series does not converge."""
    try:
        return models.tanh(z)
    except ArithmeticError:
        return models.tanh_line(z)


def _sigmoid(z: Model) -> Model:
    return plus(scale(_tanh(scale(z, HALF)), HALF), HALF)


def _product(z: Model, w: Model) -> Model:
    if _is_number(w):
        return scale(z, w[0])
    return scale(w, z[0]) if _is_number(z) else models.multiply(z, w)


def _quotients(operands: list[Values]) -> Values:
    above, below = operands
    inverse = [_reciprocal(z) for z in below]
    return _elementwise(_product)([above, inverse])


def _greater(z: Model, w: Model) -> bool | None:
    y = models.subtract(z, w)
    if models.positive(y):
        return True
    return False if bound(y) <= 0 or models.positive(models.negative(y)) else None


def _at_least(z: Model, w: Model) -> bool | None:
    y = models.subtract(z, w)
    if models.positive(models.negative(y)):
        return False
    return True if bound(y) >= 0 or models.positive(y) else None


def _chosen(condition: bool | None, z: Model, w: Model) -> Model:
    """Return z or w; where it is open which, their mean and half of how far they are apart."""
    if isinstance(condition, bool):
        return z if condition else w
    if condition is not None:
        raise TypeError("Where is not of a comparison")
    apart = abs(bound(models.subtract(z, w))).upper()
    mean = scale(models.add(z, w), HALF)
    return [*mean[:-1], mean[-1] + apart * HALF * UNIT]


#: How many operands, None: any number; what they become.
_OPERATORS: dict[str, tuple[int | None, Callable[[list[Values]], Values]]] = {
    "Add": (2, _elementwise(models.add)),
    "Sub": (2, _elementwise(models.subtract)),
    "Mul": (2, _elementwise(_product)),
    "Div": (2, _quotients),
    "Neg": (1, _elementwise(models.negative)),
    "Tanh": (1, _elementwise(_tanh)),
    "Sigmoid": (1, _elementwise(_sigmoid)),
    "Relu": (1, _elementwise(models.relu)),
    "Sin": (1, _elementwise(models.sine)),
    "Cos": (1, _elementwise(models.cosine)),
    "Max": (None, _folded(_maximum)),
    "Min": (None, _folded(_minimum)),
    "Concat": (None, _joined),
    "Greater": (2, _elementwise(_greater)),
    "GreaterOrEqual": (2, _elementwise(_at_least)),
    "Where": (3, _elementwise(_chosen)),
}

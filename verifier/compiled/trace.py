"""Programs without branches: what a kernel computes, traced by running its Python code once.

A ``Value`` stands for a double at each place of a batch; arithmetic on Values is written down in
their ``Trace``. Equal operations are written once. A trace can be evaluated with NumPy or
compiled (verifier.compiled.emit): both do the same IEEE operations, each rounded to nearest,
in the same order, so that results agree bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Adding and taking away this rounds |x| < 2**51 to the nearest integer, ties to even.
_INTEGERS = 1.5 * 2.0**52


@dataclass(frozen=True)
class Table:
    """An array parameter of a kernel: ``[width, places]``.

    index: the number of the index array that tells which of its places is read at each place of
    the batch; None: its places are those of the batch.
    """

    width: int
    index: int | None


class Trace:
    """A program under construction; ``tables`` and ``indices`` are its parameters, in order."""

    def __init__(self) -> None:
        self.operations: list[tuple] = []
        self.tables: list[Table] = []
        self.indices = 0
        self._known: dict[tuple, Value] = {}

    def index(self) -> int:
        """Add an index array; return its number."""
        self.indices += 1
        return self.indices - 1

    def table(self, width: int, index: int | None = None) -> list[Value]:
        """Add an array; return the Values read from it."""
        self.tables.append(Table(width, index))
        return [self.add("load", len(self.tables) - 1, k) for k in range(width)]

    def column(self, index: int | None = None) -> Value:
        """Add an array of width 1."""
        return self.table(1, index)[0]

    def add(self, *operation: object) -> Value:
        """Write down an operation (a name and the places of its operands), unless it is known."""
        known = self._known.get(operation)
        if known is None:
            known = Value(self, len(self.operations))
            self.operations.append(operation)
            self._known[operation] = known
        return known

    def number(self, x: Value | float) -> Value:
        """Return a Value for a real constant."""
        if isinstance(x, Value):
            return x
        x = float(x)
        # By its bits: 0.0 == -0.0.
        return self.add("constant", x.hex())


class Value:
    """A double (of a comparison: a truth value) at each place of a batch."""

    __slots__ = ("place", "trace")
    # NumPy leaves mixed arithmetic to this class.
    __array_ufunc__ = None

    def __init__(self, trace: Trace, place: int) -> None:
        self.trace = trace
        self.place = place

    def _with(self, name: str, other: Value | float) -> Value:
        return self.trace.add(name, self.place, self.trace.number(other).place)

    def __add__(self, other: Value | float) -> Value:
        return self._with("fadd", other)

    def __radd__(self, other: float) -> Value:
        return self.trace.number(other) + self

    def __sub__(self, other: Value | float) -> Value:
        return self._with("fsub", other)

    def __rsub__(self, other: float) -> Value:
        return self.trace.number(other) - self

    def __mul__(self, other: Value | float) -> Value:
        return self._with("fmul", other)

    def __rmul__(self, other: float) -> Value:
        return self.trace.number(other) * self

    def __truediv__(self, other: Value | float) -> Value:
        return self._with("fdiv", other)

    def __rtruediv__(self, other: float) -> Value:
        return self.trace.number(other) / self

    def __neg__(self) -> Value:
        return self.trace.add("fneg", self.place)

    def __abs__(self) -> Value:
        return self.trace.add("fabs", self.place)

    def __lt__(self, other: Value | float) -> Value:
        return self._with("olt", other)

    def __le__(self, other: Value | float) -> Value:
        return self._with("ole", other)

    def __gt__(self, other: Value | float) -> Value:
        return self._with("ogt", other)

    def __ge__(self, other: Value | float) -> Value:
        return self._with("oge", other)

    def __and__(self, other: Value) -> Value:
        return self._with("and", other)

    def __or__(self, other: Value) -> Value:
        return self._with("or", other)

    def __invert__(self) -> Value:
        return self.trace.add("not", self.place)


def where(condition: Value, yes: Value | float, no: Value | float) -> Value:
    """Return ``yes`` where the condition holds (comparisons with NaN do not), else ``no``."""
    number = condition.trace.number
    return condition.trace.add("select", condition.place, number(yes).place, number(no).place)


def maximum(a: Value, b: Value | float) -> Value:
    """Return the larger; NaN where one of the two is NaN."""
    return _pick("max", a, b)


def minimum(a: Value, b: Value | float) -> Value:
    """Return the smaller; NaN where one of the two is NaN."""
    return _pick("min", a, b)


def _pick(name: str, a: Value, b: Value | float) -> Value:
    # "max" and "min" return their second operand where the two do not compare: b's NaN.
    picked = a._with(name, b)
    return where(a._with("uno", a), a, picked)


def rint(x: Value) -> Value:
    """Return the nearest integer, ties to even, of |x| < 2^51."""
    return (x + _INTEGERS) - _INTEGERS


def power_of_two(n: Value) -> Value:
    """Return 2^n for an integer n in [-1022, 1023]; a double without meaning for all other n."""
    # The last bits of this sum are those of n + 1023, the exponent's field.
    return n.trace.add("exponent", (n + (_INTEGERS + 1023.0)).place)


def square_root(x: Value) -> Value:
    """Return the square root, rounded to nearest; NaN below 0."""
    return x.trace.add("sqrt", x.place)


def total(values: Sequence[Value]) -> Any:
    """Return the sum, from the first to the last; the number 0.0 of none."""
    if not values:
        return 0.0
    result = values[0]
    for value in values[1:]:
        result = result + value
    return result


def _exponent(x: Array) -> Array:
    return (x.view(np.uint64) << np.uint64(52)).view(float)


_NUMPY: dict[str, Callable] = {
    "fadd": np.add,
    "fsub": np.subtract,
    "fmul": np.multiply,
    "fdiv": np.divide,
    "fneg": np.negative,
    "fabs": np.abs,
    "sqrt": np.sqrt,
    "olt": np.less,
    "ole": np.less_equal,
    "ogt": np.greater,
    "oge": np.greater_equal,
    "uno": lambda a, b: np.isnan(a) | np.isnan(b),
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "select": np.where,
    "max": lambda a, b: np.where(a > b, a, b),
    "min": lambda a, b: np.where(a < b, a, b),
    "exponent": _exponent,
}


def evaluate(
    trace: Trace, outputs: Sequence[Value], tables: Sequence[Array], indices: Sequence[Index]
) -> Array:
    """Return the outputs ``[len(outputs), N]`` of a traced program, by NumPy."""
    loaded = [
        table if t.index is None else table[:, indices[t.index]]
        for t, table in zip(trace.tables, tables, strict=True)
    ]
    values: list[Array] = []
    with np.errstate(all="ignore"):
        for name, *operands in trace.operations:
            if name == "load":
                values.append(loaded[operands[0]][operands[1]])
            elif name == "constant":
                values.append(np.array(float.fromhex(operands[0])))
            else:
                values.append(_NUMPY[name](*[values[i] for i in operands]))
    return np.array(np.broadcast_arrays(*[values[v.place] for v in outputs]))

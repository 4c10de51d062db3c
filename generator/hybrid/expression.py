"""Expressions of a hybrid automaton: small immutable trees over named real variables.

Numbers stay as they are given. The operators of ``Expression`` leave out terms and factors
that are exactly 0 or 1 and do no other arithmetic, so nothing is rounded on the way from an
instance to a printed file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

#: Values of variables by name.
Values = Mapping[str, float]
#: An expression made ready to be computed many times.
Compiled = Callable[[Values], float]

#: The functions that an expression may call. A polynomial calls none.
FUNCTIONS: dict[str, Callable[[float], float]] = {
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "atan": math.atan,
    "tanh": math.tanh,
    "sigmoid": lambda x: 0.5 + 0.5 * math.tanh(0.5 * x),  # exp would overflow
    "sqrt": math.sqrt,
    "relu": lambda x: max(x, 0.0),
}


@dataclass(frozen=True)
class Expression:
    """Base of all nodes; numbers mix with expressions in the operators + - * /."""

    def __add__(self, other: Expression | float) -> Expression:
        return add(self, constant(other))

    def __radd__(self, other: float) -> Expression:
        return add(constant(other), self)

    def __sub__(self, other: Expression | float) -> Expression:
        return subtract(self, constant(other))

    def __rsub__(self, other: float) -> Expression:
        return subtract(constant(other), self)

    def __mul__(self, other: Expression | float) -> Expression:
        return multiply(self, constant(other))

    def __rmul__(self, other: float) -> Expression:
        return multiply(constant(other), self)

    def __truediv__(self, other: Expression | float) -> Expression:
        return Quotient(self, constant(other))

    def __pow__(self, exponent: int) -> Expression:
        return Power(self, exponent)

    def __neg__(self) -> Expression:
        return negate(self)


@dataclass(frozen=True)
class Constant(Expression):
    """A number: the double ``value``."""

    value: float


@dataclass(frozen=True)
class Variable(Expression):
    """A variable of the automaton."""

    name: str


@dataclass(frozen=True)
class Negative(Expression):
    """``-operand``."""

    operand: Expression


@dataclass(frozen=True)
class Sum(Expression):
    """``left + right``."""

    left: Expression
    right: Expression


@dataclass(frozen=True)
class Difference(Expression):
    """``left - right``."""

    left: Expression
    right: Expression


@dataclass(frozen=True)
class Product(Expression):
    """``left * right``."""

    left: Expression
    right: Expression


@dataclass(frozen=True)
class Quotient(Expression):
    """``left / right``; no polynomial."""

    left: Expression
    right: Expression


@dataclass(frozen=True)
class Power(Expression):
    """``base ** exponent``, exponent 2, 3, ..."""

    base: Expression
    exponent: int


@dataclass(frozen=True)
class Call(Expression):
    """``function(argument)``, one of FUNCTIONS; no polynomial."""

    function: str
    argument: Expression


@dataclass(frozen=True)
class Dot(Expression):
    """``weights[0] * terms[0] + weights[1] * terms[1] + ... + bias``, a neuron's sum."""

    weights: tuple[float, ...]
    terms: tuple[Expression, ...]
    bias: float = 0.0


ZERO, ONE = Constant(0.0), Constant(1.0)


def constant(value: Expression | float) -> Expression:
    """Return an expression as it is, and a number as one."""
    return value if isinstance(value, Expression) else Constant(float(value))


def variables(names: Sequence[str]) -> tuple[Variable, ...]:
    """Return a variable for each name."""
    return tuple(Variable(name) for name in names)


def add(left: Expression, right: Expression) -> Expression:
    """Return ``left + right`` without zeros."""
    if left == ZERO:
        return right
    if right == ZERO:
        return left
    if isinstance(left, Negative):
        return subtract(right, left.operand)
    if isinstance(right, Negative):
        return Difference(left, right.operand)
    if isinstance(right, Constant) and right.value < 0:
        return Difference(left, Constant(-right.value))
    return Sum(left, right)


def subtract(left: Expression, right: Expression) -> Expression:
    """Return ``left - right`` without zeros."""
    if right == ZERO:
        return left
    if left == ZERO:
        return negate(right)
    if isinstance(right, Negative):
        return Sum(left, right.operand)
    if isinstance(right, Constant) and right.value < 0:
        return Sum(left, Constant(-right.value))
    return Difference(left, right)


def negate(operand: Expression) -> Expression:
    """Return ``-operand``."""
    if isinstance(operand, Constant):
        return Constant(-operand.value + 0.0)
    if isinstance(operand, Negative):
        return operand.operand
    if isinstance(operand, Difference):
        return Difference(operand.right, operand.left)
    return Negative(operand)


def multiply(left: Expression, right: Expression) -> Expression:
    """Return ``left * right`` without zeros and ones."""
    if ZERO in (left, right):
        return ZERO
    for one, other in ((left, right), (right, left)):
        if one == ONE:
            return other
        if one == Constant(-1.0):
            return negate(other)
    return Product(left, right)


def children(expression: Expression) -> tuple[Expression, ...]:
    """Return the operands of a node."""
    match expression:
        case Sum(a, b) | Difference(a, b) | Product(a, b) | Quotient(a, b):
            return a, b
        case Negative(a) | Power(a, _) | Call(_, a):
            return (a,)
        case Dot(_, terms, _):
            return terms
    return ()


def walk(expression: Expression) -> Iterator[Expression]:
    """Yield all nodes of a tree."""
    todo = [expression]
    while todo:
        node = todo.pop()
        yield node
        if not isinstance(node, Variable | Constant):
            todo.extend(children(node))


def is_polynomial(expression: Expression) -> bool:
    """Tell whether an expression uses only + - * and powers."""
    return not any(isinstance(node, Quotient | Call) for node in walk(expression))


def names_in(expression: Expression) -> set[str]:
    """Return the names of the variables of an expression."""
    return {node.name for node in walk(expression) if isinstance(node, Variable)}


def renamed(expression: Expression, names: Mapping[str, str]) -> Expression:
    """Return the same tree with other names of variables."""
    match expression:
        case Variable(name):
            return Variable(names.get(name, name))
        case Constant():
            return expression
        case Dot(weights, terms, bias):
            return Dot(weights, tuple(renamed(term, names) for term in terms), bias)
        case Power(base, exponent):
            return Power(renamed(base, names), exponent)
        case Call(function, argument):
            return Call(function, renamed(argument, names))
    parts = [renamed(child, names) for child in children(expression)]
    return type(expression)(*parts)


def evaluate(expression: Expression, values: Values) -> float:
    """Return the value of an expression in float64."""
    return compiled(expression)(values)


def compiled(expression: Expression) -> Compiled:
    """Return a function that computes an expression in float64, from the leaves up."""
    match expression:
        case Constant(value):
            return lambda _: value
        case Variable(name):
            return lambda values: values[name]
        case Power(base, exponent):
            inner = compiled(base)
            return lambda values: inner(values) ** exponent
        case Negative(operand):
            inner = compiled(operand)
            return lambda values: -inner(values)
        case Call(function, argument):
            apply, inner = FUNCTIONS[function], compiled(argument)
            return lambda values: apply(inner(values))
        case Dot(weights, terms, bias):
            return _compiled_dot(weights, terms, bias)
    left, right = (compiled(child) for child in children(expression))
    match expression:
        case Sum():
            return lambda values: left(values) + right(values)
        case Difference():
            return lambda values: left(values) - right(values)
        case Product():
            return lambda values: left(values) * right(values)
        case Quotient():
            return lambda values: left(values) / right(values)
    raise TypeError(f"unknown expression {type(expression).__name__}")


def _compiled_dot(
    weights: tuple[float, ...], terms: tuple[Expression, ...], bias: float
) -> Compiled:
    parts = [compiled(term) for term in terms]

    def total(values: Values) -> float:
        products = [w * part(values) for w, part in zip(weights, parts, strict=True)]
        return math.fsum(products) + bias

    return total

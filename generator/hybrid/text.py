"""Expressions as infix text that Flow*, SpaceEx and Verisig all read.

The common ground of their grammars: a minus sign touches a number only where nothing stands
before it (Flow* reads ``y -0.3`` as two values, ``y - 0.3`` as a difference), a number never
has a capital E or a plus in its exponent, and powers have whole exponents.
"""

from __future__ import annotations

from decimal import Decimal

from generator.hybrid.expression import (
    Call,
    Constant,
    Difference,
    Dot,
    Expression,
    Negative,
    Power,
    Product,
    Quotient,
    Sum,
    Variable,
)

_SUM, _PRODUCT, _UNARY, _POWER, _ATOM = range(5)


def number(value: float) -> str:
    """Return the shortest text that reads back as the same double."""
    text = repr(float(value) + 0.0)
    # A plus in an exponent needs a point before it in one grammar and is refused in others.
    return f"{Decimal(text):f}.0" if "e+" in text else text


def infix(expression: Expression) -> str:
    """Return the text of an expression."""
    return _text(expression, _SUM)


def _text(expression: Expression, least: int) -> str:
    """Return the text, in parentheses if it binds weaker than ``least``."""
    strength, text = _parts(expression)
    return f"({text})" if strength < least else text


def _parts(expression: Expression) -> tuple[int, str]:
    match expression:
        case Constant(value):
            return (_SUM if value < 0 else _ATOM), number(value)
        case Variable(name):
            return _ATOM, name
        case Sum(a, b):
            return _SUM, f"{_text(a, _SUM)} + {_text(b, _PRODUCT)}"
        case Difference(a, b):
            return _SUM, f"{_text(a, _SUM)} - {_text(b, _PRODUCT)}"
        case Product(a, b):
            return _PRODUCT, f"{_text(a, _PRODUCT)} * {_text(b, _POWER)}"
        case Quotient(a, b):
            return _PRODUCT, f"{_text(a, _PRODUCT)} / {_text(b, _POWER)}"
        case Negative(a):
            # In parentheses wherever it is not the first. Readers differ on what -x^2 means.
            return _SUM, f"-{_text(a, _ATOM)}"
        case Power(a, exponent):
            return _POWER, f"{_text(a, _ATOM)}^{exponent}"
        case Call(function, a):
            return _ATOM, f"{function}({_text(a, _SUM)})"
        case Dot(weights, terms, bias):
            return _dot(weights, terms, bias)
    raise TypeError(f"unknown expression {type(expression).__name__}")


def _dot(weights: tuple[float, ...], terms: tuple[Expression, ...], bias: float) -> tuple[int, str]:
    """Return a weighted sum, signs as operators, zero weights left out."""
    signed = [
        (w, f"{number(abs(w))} * {_text(t, _POWER)}")
        for w, t in zip(weights, terms, strict=True)
        if w
    ]
    if bias or not signed:
        signed.append((bias, number(abs(bias))))
    first, *rest = signed
    head = f"-{first[1]}" if first[0] < 0 else first[1]
    return _SUM, head + "".join(f" {'-' if w < 0 else '+'} {text}" for w, text in rest)

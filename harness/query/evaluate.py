"""Evaluate a query at given inputs and outputs.

Whether it holds is decided exactly, in fractions: nothing is rounded, neither a bound nor a value.
Whether it holds with the tolerance is decided as VNN-COMP 2026 does, which moves a bound on an
input by the tolerance and rounds it to the network's type. So a tool that returns a bound as the
network reads it is credited, and has proved nothing where that is beyond the bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from harness.query.terms import And, Comparison, Element, Formula, Query, Relation, Term

#: Absolute, of every comparison that is about inputs alone; VNN-COMP 2026's.
TOLERANCE = Fraction(1, 10_000)

#: By tensor, in the order of Query.tensors, then row-major; outputs may be missing.
Values = Sequence[Sequence[Fraction]]
#: The network's type: rounds a float.
Rounding = Callable[[float], np.floating]
#: A fraction or an infinity.
Real = Fraction | float


@dataclass(frozen=True)
class Place:
    """Where inputs lie relative to what a query says of them.

    outside: the least absolute change of all bounds with which the inputs are allowed (0:
    allowed; infinite: no change helps); line: of the bound that asks for it; allowed, within:
    whether they are allowed exactly, and with the tolerance.
    """

    outside: float
    line: int | None
    allowed: bool
    within: bool


def place_inputs(query: Query, values: Values, rounding: Rounding = np.float32) -> Place:
    """Return where the inputs lie; of the outputs nothing is asked."""
    slack = _Slack(values, rounding)

    def needed(comparison: Comparison) -> tuple[Real, int]:
        if not comparison.on_inputs:
            return 0, comparison.line
        found = slack(comparison)
        if comparison.relation is Relation.DIFFERENT:
            return (0 if found else math.inf), comparison.line
        return max(-found, Fraction(0)), comparison.line

    outside, line = _fold(query, needed)
    allowed = _all_hold(query, lambda c: not c.on_inputs or slack.holds(c))
    return Place(
        outside=_float(outside),
        line=line if outside else None,
        allowed=allowed,
        within=allowed or _all_hold(query, lambda c: not c.on_inputs or slack.within(c)),
    )


@dataclass(frozen=True)
class Finding:
    """What a query says at inputs and outputs.

    holds, within: whether all assertions hold exactly, and with the tolerance on inputs;
    violation: by how much the outputs meet what is asserted of them, in their own unit,
    wherever the inputs are allowed with the tolerance (negative: by how much they miss it,
    infinite: nothing is asserted of them, or nothing where the inputs lie).
    """

    holds: bool
    within: bool
    violation: float


def evaluate(query: Query, values: Values, rounding: Rounding = np.float32) -> Finding:
    """Return what the query says at finite inputs and outputs."""
    slack = _Slack(values, rounding)

    def met(comparison: Comparison) -> tuple[Real, int]:
        if not comparison.on_inputs:
            return -slack(comparison), comparison.line
        inside = slack.holds(comparison) or slack.within(comparison)
        return (-math.inf if inside else math.inf), comparison.line

    missed, _ = _fold(query, met)
    return Finding(
        holds=_all_hold(query, slack.holds),
        within=_all_hold(query, slack.within),
        violation=-_float(missed),
    )


def _fold(query: Query, rate: Callable[[Comparison], tuple[Real, int]]) -> tuple[Real, int]:
    """Return the largest of a conjunction's ratings, the least of a disjunction's."""

    def of(formula: Formula) -> tuple[Real, int]:
        if isinstance(formula, Comparison):
            return rate(formula)
        choose = max if isinstance(formula, And) else min
        return choose([of(part) for part in formula.parts], key=_amount)

    return max([of(assertion) for assertion in query.assertions], key=_amount)


def _float(value: Real) -> float:
    """Return the nearest float, an infinity beyond all floats."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _amount(rating: tuple[Real, int]) -> Real:
    return rating[0]


def _all_hold(query: Query, holds: Callable[[Comparison], bool]) -> bool:
    def of(formula: Formula) -> bool:
        if isinstance(formula, Comparison):
            return holds(formula)
        join = all if isinstance(formula, And) else any
        return join(of(part) for part in formula.parts)

    return all(of(assertion) for assertion in query.assertions)


def _holds(relation: Relation, slack: Fraction, tolerance: Fraction) -> bool:
    """Return whether a comparison holds; as in VNN-COMP, != is to hold by the tolerance."""
    if relation in (Relation.LESS, Relation.GREATER):
        return slack > -tolerance
    if relation is Relation.DIFFERENT:
        return slack > tolerance
    return slack >= -tolerance


class _Slack:
    """By how much a comparison holds (negative: by how much not); each is computed once."""

    def __init__(self, values: Values, rounding: Rounding) -> None:
        self._values, self._rounding = values, rounding
        self._found: dict[int, Fraction] = {}

    def holds(self, comparison: Comparison) -> bool:
        """Whether it holds exactly."""
        return _holds(comparison.relation, self(comparison), Fraction(0))

    def within(self, comparison: Comparison) -> bool:
        """Whether it holds with the tolerance on inputs, or would if its bound were rounded."""
        tolerance = TOLERANCE if comparison.tolerant else Fraction(0)
        if _holds(comparison.relation, self(comparison), tolerance):
            return True
        if not comparison.on_inputs or comparison.relation not in _AT_MOST:
            return False
        left, right = comparison.left, comparison.right
        if not _AT_MOST[comparison.relation]:
            left, right = right, left
        if isinstance(left, Element) and isinstance(right, Fraction):
            slack = self._rounded(right + tolerance) - self._value(left)
        elif isinstance(left, Fraction) and isinstance(right, Element):
            slack = self._value(right) - self._rounded(left - tolerance)
        else:
            return False
        return _holds(comparison.relation, slack, Fraction(0))

    def _rounded(self, bound: Fraction) -> Fraction:
        try:
            with np.errstate(over="ignore"):
                rounded = float(self._rounding(float(bound)))
        except OverflowError:
            return bound
        return Fraction(rounded) if math.isfinite(rounded) else bound

    def __call__(self, comparison: Comparison) -> Fraction:
        found = self._found.get(id(comparison))
        if found is None:
            difference = self._value(comparison.right) - self._value(comparison.left)
            found = self._found[id(comparison)] = _SLACKS[comparison.relation](difference)
        return found

    def _value(self, term: Term) -> Fraction:
        if isinstance(term, Element):
            return self._values[term.tensor][term.index]
        if isinstance(term, Fraction):
            return term
        values = [self._value(part) for part in term.terms]
        if term.operator == "+":
            return sum(values, Fraction(0))
        if term.operator == "*":
            return math.prod(values, start=Fraction(1))
        return -values[0] if len(values) == 1 else values[0] - sum(values[1:], Fraction(0))


#: The relations of order: whether the left side is to be the smaller one.
_AT_MOST = {
    Relation.AT_MOST: True,
    Relation.LESS: True,
    Relation.AT_LEAST: False,
    Relation.GREATER: False,
}
_SLACKS: dict[Relation, Callable[[Fraction], Fraction]] = {
    Relation.AT_MOST: lambda difference: difference,
    Relation.LESS: lambda difference: difference,
    Relation.AT_LEAST: lambda difference: -difference,
    Relation.GREATER: lambda difference: -difference,
    Relation.EQUAL: lambda difference: -abs(difference),
    Relation.DIFFERENT: abs,
}

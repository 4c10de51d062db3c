"""Evaluate a query exactly at given inputs and outputs.

All arithmetic is in fractions: nothing is rounded, neither a bound nor a value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

from harness.query.terms import And, Comparison, Element, Formula, Query, Relation, Term

#: Absolute, of every comparison that is about inputs alone; VNN-COMP 2026's.
TOLERANCE = Fraction(1, 10_000)

#: By tensor, in the order of Query.tensors, then row-major; outputs may be missing.
Values = Sequence[Sequence[Fraction]]
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


def place_inputs(query: Query, values: Values) -> Place:
    """Return where the inputs lie; of the outputs nothing is asked."""
    slack = _Slack(values)

    def needed(comparison: Comparison) -> tuple[Real, int]:
        if not comparison.on_inputs:
            return 0, comparison.line
        found = slack(comparison)
        if comparison.relation is Relation.DIFFERENT:
            return (0 if found else math.inf), comparison.line
        return max(-found, Fraction(0)), comparison.line

    outside, line = _fold(query, needed)
    return Place(
        outside=float(outside),
        line=line if outside else None,
        allowed=_all_hold(query, lambda c: not c.on_inputs or _holds(c, slack(c), Fraction(0))),
        within=_all_hold(query, lambda c: not c.on_inputs or _holds(c, slack(c), TOLERANCE)),
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


def evaluate(query: Query, values: Values) -> Finding:
    """Return what the query says at finite inputs and outputs."""
    slack = _Slack(values)

    def met(comparison: Comparison) -> tuple[Real, int]:
        found = slack(comparison)
        if not comparison.on_inputs:
            return -found, comparison.line
        return (-math.inf if _holds(comparison, found, TOLERANCE) else math.inf), comparison.line

    missed, _ = _fold(query, met)
    return Finding(
        holds=_all_hold(query, lambda c: _holds(c, slack(c), Fraction(0))),
        within=_all_hold(query, lambda c: _holds(c, slack(c), TOLERANCE)),
        violation=-float(missed),
    )


def _fold(query: Query, rate: Callable[[Comparison], tuple[Real, int]]) -> tuple[Real, int]:
    """Return the largest of a conjunction's ratings, the least of a disjunction's."""

    def of(formula: Formula) -> tuple[Real, int]:
        if isinstance(formula, Comparison):
            return rate(formula)
        choose = max if isinstance(formula, And) else min
        return choose([of(part) for part in formula.parts], key=_amount)

    return max([of(assertion) for assertion in query.assertions], key=_amount)


def _amount(rating: tuple[Real, int]) -> Real:
    return rating[0]


def _all_hold(query: Query, holds: Callable[[Comparison], bool]) -> bool:
    def of(formula: Formula) -> bool:
        if isinstance(formula, Comparison):
            return holds(formula)
        join = all if isinstance(formula, And) else any
        return join(of(part) for part in formula.parts)

    return all(of(assertion) for assertion in query.assertions)


def _holds(comparison: Comparison, slack: Fraction, tolerance: Fraction) -> bool:
    """Return whether a comparison holds; as in VNN-COMP, != is to hold by the tolerance."""
    allowed = tolerance if comparison.tolerant else Fraction(0)
    if comparison.relation in (Relation.LESS, Relation.GREATER):
        return slack > -allowed
    if comparison.relation is Relation.DIFFERENT:
        return slack > allowed
    return slack >= -allowed


class _Slack:
    """By how much a comparison holds (negative: by how much not); each is computed once."""

    def __init__(self, values: Values) -> None:
        self._values = values
        self._found: dict[int, Fraction] = {}

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


_SLACKS: dict[Relation, Callable[[Fraction], Fraction]] = {
    Relation.AT_MOST: lambda difference: difference,
    Relation.LESS: lambda difference: difference,
    Relation.AT_LEAST: lambda difference: -difference,
    Relation.GREATER: lambda difference: -difference,
    Relation.EQUAL: lambda difference: -abs(difference),
    Relation.DIFFERENT: abs,
}

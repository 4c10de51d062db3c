"""The checker's own reader of VNN-LIB: a question as a list of cases, all numbers exact.

A case is a box of inputs and a conjunction of linear conditions on outputs. Whatever else a file
asserts (a relation between inputs, an inequality by !=) is left out of a case: it then allows
more, and what is proved of it holds all the more. Strict conditions are read as not strict.
"""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from checker.files import Unreadable

#: A question is not read beyond so many cases.
MOST_CASES = 100_000
_TOKEN = re.compile(r"[()]|[^\s()\[\]]+(?:[ \t]*\[[^\[\]()]*\])?|\S")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")
_FLAT = re.compile(r"([XY])_(0|[1-9]\d{0,8})")
_TENSOR = re.compile(r"([^\s\[\]]+)[ \t]*\[([\d, \t]*)\]")
#: Nested deeper, a file is refused.
_DEEPEST = 50

#: A sum of multiples of inputs ("X", i) and outputs ("Y", i); under None the constant.
Sum = dict[Any, Fraction]


@dataclass(frozen=True)
class Condition:
    """``sum of factor * output <= most``; factors: by output."""

    factors: tuple[tuple[int, Fraction], ...]
    most: Fraction


@dataclass(frozen=True)
class Case:
    """One way to fulfil a question: inputs in a closed box, and all conditions on outputs."""

    lower: tuple[Fraction, ...]
    upper: tuple[Fraction, ...]
    conditions: tuple[Condition, ...]


@dataclass(frozen=True)
class Question:
    """A question: it is unsat if no case can be fulfilled; inputs, outputs: how many there are."""

    inputs: int
    outputs: int
    cases: tuple[Case, ...]


def read_question(text: str, where: str) -> Question:
    """Read VNN-LIB 1.0, or 2.0 with one network; Unreadable if it says what is not known here."""
    try:
        forms = _forms(text)
        new = bool(forms) and isinstance(forms[0], list) and forms[0][:1] == ["vnnlib-version"]
        names, sizes, assertions = _declared_2(forms) if new else _declared_1(forms)
        alternatives = _alternatives(["and", *(_only(form) for form in assertions)], names)
        read: dict[int, _Part] = {}  # the same condition stands in many alternatives
        cases = (_case(conditions, sizes["X"], read) for conditions in alternatives)
        found = tuple(case for case in cases if case is not None)
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise Unreadable(f"{where}: not a VNN-LIB question that is known here ({error})") from None
    return Question(sizes["X"], sizes["Y"], found)


def _forms(text: str) -> list[Any]:
    """Return nested lists of words."""
    top: list[Any] = []
    open_lists = [top]
    for token in _TOKEN.findall(re.sub(r";[^\n]*", "", text)):
        if token == "(":
            open_lists[-1].append([])
            open_lists.append(open_lists[-1][-1])
        elif token == ")":
            open_lists.pop()
        elif token in "[]":
            raise ValueError("a bracket stands alone")
        else:
            open_lists[-1].append(token)
        if not 0 < len(open_lists) <= _DEEPEST:
            raise ValueError("parentheses that do not match, or nested too deep")
    if len(open_lists) > 1:
        raise ValueError("a parenthesis is never closed")
    return top


def _declared_1(forms: list[Any]) -> tuple[dict[str, Any], dict[str, int], list[Any]]:
    names: dict[str, Any] = {}
    sizes = {"X": 0, "Y": 0}
    declared = [form for form in forms if form[0] == "declare-const"]
    for _, name, kind in declared:
        match = _FLAT.fullmatch(name)
        if match is None or kind != "Real" or int(match[2]) != sizes[match[1]]:
            raise ValueError(f"{name} is declared out of order, or not as Real")
        names[name] = (match[1], int(match[2]))
        sizes[match[1]] += 1
    return names, sizes, [form for form in forms if form[0] != "declare-const"]


def _declared_2(forms: list[Any]) -> tuple[dict[str, Any], dict[str, int], list[Any]]:
    _, (network, _, *tensors), *assertions = forms
    if network != "declare-network":
        raise ValueError("a network must be declared first")
    names: dict[str, Any] = {}
    sizes = {"X": 0, "Y": 0}
    for declare, name, _, *shape in ([t[0], t[1], *t[2:]] for t in map(_spread, tensors)):
        side = {"declare-input": "X", "declare-output": "Y"}[declare]
        for index in itertools.product(*map(range, shape)):
            names[f"{name}[{','.join(map(str, index))}]"] = (side, sizes[side])
            sizes[side] += 1
    if len(names) != sum(sizes.values()):
        raise ValueError("a name is declared twice")
    return names, sizes, assertions


def _spread(tensor: list[str]) -> list[Any]:
    """Return declare-input or -output, name, type, and the numbers of a shape."""
    declare, name, rest = tensor
    match = _TENSOR.fullmatch(rest)
    if match is None:
        raise ValueError(f"{rest} is not a type and a shape")
    return [declare, name, match[1], *(int(n) for n in match[2].split(","))]


def _only(form: list[Any]) -> Any:
    head, condition = form
    if head != "assert":
        raise ValueError(f"{head} is not known")
    return condition


def _alternatives(formula: Any, names: dict[str, Any]) -> list[list[Sum]]:
    """Return the disjunctive normal form: conjunctions of sums that are to be at most 0."""
    head, *parts = formula
    if head in ("and", "or"):
        if not parts:
            raise ValueError(f"({head}) joins nothing")
        found = [_alternatives(part, names) for part in parts]
        if head == "or":
            joined = list(itertools.chain(*found))
        else:
            if math.prod(map(len, found)) > MOST_CASES:
                raise ValueError(f"more than {MOST_CASES} cases")
            joined = [list(itertools.chain(*choice)) for choice in itertools.product(*found)]
        if len(joined) > MOST_CASES:
            raise ValueError(f"more than {MOST_CASES} cases")
        return joined
    left, right = (_sum(part, names) for part in parts)
    difference = _plus(left, right, -1)
    if head in ("<=", "<"):
        return [[difference]]
    if head in (">=", ">"):
        return [[_times(difference, Fraction(-1))]]
    if head == "==":
        return [[difference, _times(difference, Fraction(-1))]]
    if head == "!=":
        return [[]]
    raise ValueError(f"{head} is not known")


def _sum(term: Any, names: dict[str, Any]) -> Sum:
    if isinstance(term, str):
        place = names.get(re.sub(r"[ \t]", "", term))
        if place is not None:
            return {place: Fraction(1)}
        if not _NUMBER.fullmatch(term):
            raise ValueError(f"{term[:40]} is neither a number nor declared")
        return {None: Fraction(term)}
    operator, *parts = term
    first, *others = (_sum(part, names) for part in parts)
    if operator == "-" and not others:
        return _times(first, Fraction(-1))
    for other in others:
        if operator == "+":
            first = _plus(first, other, 1)
        elif operator == "-":
            first = _plus(first, other, -1)
        elif operator == "*" and (first.keys() <= {None} or other.keys() <= {None}):
            number, varied = (first, other) if first.keys() <= {None} else (other, first)
            first = _times(varied, number.get(None, Fraction(0)))
        else:
            raise ValueError(f"{operator} of these is not linear")
    return first


def _plus(left: Sum, right: Sum, sign: int) -> Sum:
    keys = left.keys() | right.keys()
    zero = Fraction(0)
    return {key: left.get(key, zero) + sign * right.get(key, zero) for key in keys}


def _times(value: Sum, factor: Fraction) -> Sum:
    return {key: number * factor for key, number in value.items()}


#: A bound (input, whether from above, number), or a condition on outputs, or whether it can hold.
_Part = tuple[int, bool, Fraction] | Condition | bool


def _part(given: Sum) -> _Part:
    """Return what a sum that is to be at most 0 says; True for what is left out."""
    constant = given.get(None, Fraction(0))
    factors = {key: a for key, a in given.items() if key is not None and a != 0}
    sides = {side for side, _ in factors}
    if not factors:
        return constant <= 0
    if sides == {"Y"}:
        return Condition(tuple(sorted((i, a) for (_, i), a in factors.items())), -constant)
    if sides == {"X"} and len(factors) == 1:
        (((_, i), factor),) = factors.items()
        return i, factor > 0, -constant / factor
    return True


def _case(sums: list[Sum], inputs: int, read: dict[int, _Part]) -> Case | None:
    """Return what a conjunction allows; None if it is nothing. An input must have two bounds."""
    lower: dict[int, Fraction] = {}
    upper: dict[int, Fraction] = {}
    conditions = []
    for given in sums:
        part = read.get(id(given))
        if part is None:
            part = read[id(given)] = _part(given)
        if isinstance(part, Condition):
            conditions.append(part)
        elif isinstance(part, bool):
            if not part:
                return None
        else:
            i, above, bound = part
            if above:
                upper[i] = min(bound, upper.get(i, bound))
            else:
                lower[i] = max(bound, lower.get(i, bound))
    if not len(lower) == len(upper) == inputs:
        raise ValueError("an input has no bounds")
    low, high = (tuple(ends[i] for i in range(inputs)) for ends in (lower, upper))
    if any(a > b for a, b in zip(low, high, strict=True)):
        return None
    return Case(low, high, tuple(conditions))

"""A VNN-LIB query as boxes of inputs, each with the alternatives that violate there.

The harness's reader reads the file; here its formula becomes a disjunction of conjunctions.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from harness.query.terms import And, Comparison, Element, Formula, Query, Relation, Term
from racecar.errors import BadInput

Array = NDArray[np.float64]
#: A query of more alternatives is not taken on.
MOST_ALTERNATIVES = 100_000
#: Of a box: lower and upper bound of each input.
Bounds = tuple[tuple[Fraction, Fraction], ...]


@dataclass(frozen=True, eq=False)
class Area:
    """A box of inputs, and what violates there.

    lower, upper: ``[inputs]``, rounded outwards. There is a violation where for some alternative
    all rows i of it have ``factors[i] . outputs <= most[i]``; factors: ``[rows, outputs]``;
    alternative: of each row.
    """

    lower: Array
    upper: Array
    factors: Array
    most: Array
    alternative: NDArray[np.intp]


def areas(query: Query) -> list[Area]:
    """Return all boxes of a query with one input and one output tensor.

    Raises BadInput for what is not a disjunction of boxes and linear conditions on outputs.
    """
    sizes = [sum(t.size for t in side) for side in (query.inputs, query.outputs)]
    starts = dict[int, int]()
    counts = {True: 0, False: 0}
    for place, tensor in enumerate(query.tensors):
        starts[place] = counts[tensor.is_input]
        counts[tensor.is_input] += tensor.size
    found: dict[Bounds, list[list[tuple[Array, float]]]] = {}
    parts: dict[int, list[_Part]] = {}  # the same comparison stands in many alternatives
    for alternative in _alternatives(And(query.assertions)):
        for comparison in alternative:
            if id(comparison) not in parts:
                rows_of = _linear(comparison, query, starts, sizes)
                parts[id(comparison)] = [_part(comparison, row, sizes[0]) for row in rows_of]
        said = [part for comparison in alternative for part in parts[id(comparison)]]
        bounds, rows = _box_and_rows(said, sizes[0])
        rows = rows or [(np.zeros(sizes[1]), 0.0)]  # nothing is asked of the outputs
        if bounds is not None:
            found.setdefault(bounds, []).append(rows)
    return [_area(bounds, rows) for bounds, rows in found.items()]


#: A bound (input, whether from above, number), a row about outputs, or whether it can hold.
_Part = tuple[int, bool, Fraction] | tuple[Array, float] | bool


def _part(comparison: Comparison, row: list[Fraction], count: int) -> _Part:
    """Return what a row, ``factors . (inputs, outputs) + constant <= 0``, says."""
    *factors, constant = row
    inputs = [i for i, a in enumerate(factors[:count]) if a]
    outputs = factors[count:]
    if inputs and (any(outputs) or len(inputs) > 1):
        raise BadInput(f"line {comparison.line}: it relates inputs; only boxes are known")
    if any(outputs):
        return np.array([float(a) for a in outputs]), float(-constant)
    if inputs:
        (i,) = inputs
        return i, factors[i] > 0, -constant / factors[i]
    return constant <= 0


def _box_and_rows(
    parts: Sequence[_Part], inputs: int
) -> tuple[Bounds | None, list[tuple[Array, float]]]:
    """Return the box of an alternative (None: empty) and its conditions on outputs."""
    lower, upper = dict[int, Fraction](), dict[int, Fraction]()
    rows, possible = [], True
    for part in parts:
        if isinstance(part, bool):
            possible = possible and part
        elif len(part) == 2:
            rows.append(part)
        else:
            i, above, bound = part
            if above:
                upper[i] = min(upper.get(i, bound), bound)
            else:
                lower[i] = max(lower.get(i, bound), bound)
    if not (len(lower) == len(upper) == inputs):
        raise BadInput("an input has no bounds; nothing can be said of it")
    ends = [(lower[i], upper[i]) for i in range(inputs)]
    if not possible or any(low > high for low, high in ends):
        return None, []
    return tuple(ends), rows


def _outwards(bound: Fraction, towards: float) -> float:
    """Return the float at a bound, or the next one beyond it."""
    nearest = float(bound)
    beyond = nearest > bound if towards < 0 else nearest < bound
    return float(np.nextafter(nearest, towards)) if beyond else nearest


def _area(bounds: Bounds, alternatives: list[list[tuple[Array, float]]]) -> Area:
    rows = [(row, most, k) for k, rows in enumerate(alternatives) for row, most in rows]
    return Area(
        np.array([_outwards(low, -np.inf) for low, _ in bounds]),
        np.array([_outwards(high, np.inf) for _, high in bounds]),
        np.array([row for row, _, _ in rows]),
        np.array([most for _, most, _ in rows]),
        np.array([k for _, _, k in rows], dtype=np.intp),
    )


def _alternatives(formula: Formula) -> list[list[Comparison]]:
    if isinstance(formula, Comparison):
        return [[formula]]
    parts = [_alternatives(part) for part in formula.parts]
    if isinstance(formula, And):
        count = 1
        for part in parts:
            count *= len(part)
        if count > MOST_ALTERNATIVES:
            raise BadInput(f"more than {MOST_ALTERNATIVES} alternatives; that is too many")
        return [list(itertools.chain(*choice)) for choice in itertools.product(*parts)]
    return list(itertools.chain(*parts))


def _linear(
    comparison: Comparison, query: Query, starts: dict[int, int], sizes: Sequence[int]
) -> list[list[Fraction]]:
    """Return a comparison as rows: factors of inputs and outputs, and a constant, sum <= 0."""
    if comparison.relation is Relation.DIFFERENT:
        raise BadInput(f"line {comparison.line}: != is not known")
    left = _row(comparison.left, query, starts, sizes)
    right = _row(comparison.right, query, starts, sizes)
    row = [a - b for a, b in zip(left, right, strict=True)]
    turned = [-a for a in row]
    if comparison.relation is Relation.EQUAL:
        return [row, turned]
    return [row if comparison.relation in (Relation.AT_MOST, Relation.LESS) else turned]


def _row(term: Term, query: Query, starts: dict[int, int], sizes: Sequence[int]) -> list[Fraction]:
    """Return a linear term as factors of all inputs, all outputs, and a constant."""
    row = [Fraction(0)] * (sum(sizes) + 1)
    if isinstance(term, Element):
        own = 0 if query.tensors[term.tensor].is_input else sizes[0]
        row[own + starts[term.tensor] + term.index] = Fraction(1)
        return row
    if isinstance(term, Fraction):
        row[-1] = term
        return row
    parts = [_row(part, query, starts, sizes) for part in term.terms]
    if term.operator == "*":
        product = parts[0]
        for part in parts[1:]:
            number, other = (part, product) if not any(part[:-1]) else (product, part)
            if any(number[:-1]):
                raise BadInput("a product of variables is not linear")
            product = [number[-1] * x for x in other]
        return product
    sign = 1 if term.operator == "+" or len(parts) == 1 else -1
    total = parts[0]
    for part in parts[1:]:
        total = [a + sign * b for a, b in zip(total, part, strict=True)]
    return [-x for x in total] if term.operator == "-" and len(parts) == 1 else total

"""Judging held against VNN-COMP 2026's rules, restated here in floats and in their own words."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from query_helpers import linear_network, query_1, query_2, read, witness_1, witness_2

from harness.query.judge import judge_witness
from harness.records import WitnessOutcome

STRICT, LOOSE = WitnessOutcome.CORRECT, WitnessOutcome.CORRECT_WITH_TOLERANCE
CREDIT = {STRICT: 2, LOOSE: 1}
WEIGHTS = [[1.0, 0.0], [0.5, -1.0]]
NETWORK = linear_network(WEIGHTS)


def outputs(x):
    """The network again: products and sums of these small numbers are exact in float32."""
    return [np.float32(x[0] + np.float32(0.5) * x[1]), np.float32(-x[1])]


# --- version 1.0: boxes, each with a disjunction of linear constraints on outputs ---------------


@dataclass(frozen=True)
class Case:
    """A box, and constraints (relation, left, right) on outputs that must all hold."""

    box: list
    constraints: list


def vnncomp_1(cases, x_text, y):
    """Return 2 for a strict pass, 1 for one by tolerance, 0 for none."""
    replayed = [np.float32(float(text)) for text in x_text]
    for credit, tolerance in ((2, 0.0), (1, 1e-4)):
        for case in cases:
            inside = all(
                not (value < float(low) - tolerance or value > float(high) + tolerance)
                for (low, high), value in zip(case.box, replayed, strict=True)
            )
            values = [float(v) for v in y]

            def side(term, values=values):
                return values[int(term[2:])] if term.startswith("Y_") else float(term)

            met = all(
                side(left) <= side(right) if relation == "<=" else side(left) >= side(right)
                for relation, left, right in case.constraints
            )
            if inside and met:
                return credit
    return 0


GRID = [-1.0, -0.5, 0.0, 0.5, 1.0]
DECIMALS = ["0.1", "-0.3", "0.7", "0.33333334", "1.0000001", "0.99999999"]
exact_bound = st.sampled_from(GRID).map(repr)
any_bound = exact_bound | st.sampled_from(DECIMALS)
nudge = st.sampled_from(
    [
        sign * size
        for size in (0, 1e-9, 5e-5, 9.999e-5, 1e-4, 1.00001e-4, 1.01e-4)
        for sign in (1, -1)
    ]
)


def cases(bounds):
    interval = st.tuples(bounds, bounds).filter(lambda pair: float(pair[0]) <= float(pair[1]))
    output = st.sampled_from(["Y_0", "Y_1"])
    constraint = st.tuples(st.sampled_from(["<=", ">="]), output, bounds | output)
    return st.lists(
        st.builds(
            Case,
            st.lists(interval, min_size=2, max_size=2),
            st.lists(constraint, min_size=1, max_size=2),
        ),
        min_size=1,
        max_size=3,
    )


@st.composite
def asked(draw, bounds):
    """Return cases and the decimals of an input, mostly at or near a bound."""
    chosen = draw(cases(bounds))
    box = draw(st.sampled_from(chosen)).box
    x = [repr(float(draw(st.sampled_from(pair))) + draw(nudge)) for pair in box]
    return chosen, x


def text_of(chosen):
    disjuncts = []
    for case in chosen:
        parts = [f"(>= X_{i} {low}) (<= X_{i} {high})" for i, (low, high) in enumerate(case.box)]
        parts += [f"({relation} {left} {right})" for relation, left, right in case.constraints]
        disjuncts.append(f"(and {' '.join(parts)})")
    return f"(or {' '.join(disjuncts)})"


def judged_1(chosen, x):
    query = read(query_1(2, 2, text_of(chosen)))
    found = judge_witness(query, NETWORK, "n", witness_1(list(map(float, x))))
    return CREDIT.get(found.outcome, 0), found


def fed(x):
    return [np.float32(float(value)) for value in x]


@settings(max_examples=150)
@given(asked(exact_bound))
def test_1_0_agrees_where_bounds_are_float32(question):
    chosen, x = question
    assert judged_1(chosen, x)[0] == vnncomp_1(chosen, x, outputs(fed(x)))


@settings(max_examples=150)
@given(asked(any_bound))
def test_1_0_credits_the_same_and_establishes_no_more(question):
    chosen, x = question
    ours, theirs = judged_1(chosen, x)[0], vnncomp_1(chosen, x, outputs(fed(x)))
    assert (ours > 0) == (theirs > 0)
    assert ours <= theirs


def test_1_0_is_stricter_at_a_bound_that_float32_rounds():
    case = [Case([("0.0", "0.1"), ("0.0", "0.0")], [("<=", "Y_1", "0.5")])]
    x = ["0.1", "0.0"]
    assert vnncomp_1(case, x, outputs(fed(x))) == 2
    assert judged_1(case, x)[1].outcome is LOOSE


@pytest.mark.parametrize("bad", ["nan", "inf", "-inf"])
def test_1_0_is_stricter_with_numbers_that_are_not_finite(bad):
    # Not a number is neither below nor above a bound: compared so, it lies in every box.
    case = [Case([("0.0", "0.1"), ("0.0", "0.0")], [("<=", "Y_1", "0.5")])]
    theirs = vnncomp_1(case, [bad, "0.0"], [math.nan, 0.0])
    assert theirs == (2 if bad == "nan" else 0)
    text = f"((X_0 {bad})(X_1 0.0))".encode()
    query = read(query_1(2, 2, text_of(case)))
    assert judge_witness(query, NETWORK, "n", text).outcome is WitnessOutcome.MALFORMED


# --- version 2.0: any assertions; the tolerance goes by assertion ------------------------------


def vnncomp_2(assertions, x, y):
    """Return 2, 1 or 0; assertions are (relation, left, right) or ("and" | "or", parts)."""
    values = {"X": x, "Y": y}

    def number(term):
        if isinstance(term, tuple):
            parts = [number(part) for part in term[1]]
            if term[0] == "-":
                return -parts[0] if len(parts) == 1 else parts[0] - sum(parts[1:])
            return sum(parts) if term[0] == "+" else math.prod(parts)
        return values[term[0]][int(term[2:])] if term[0] in "XY" else float(term)

    def tensors(form):
        if isinstance(form, str):
            return {form[0]} & {"X", "Y"}
        return set().union(*(tensors(part) for part in (form[1] if len(form) == 2 else form[1:])))

    def true(form, tolerance):
        if form[0] in ("and", "or"):
            return (all if form[0] == "and" else any)(true(part, tolerance) for part in form[1])
        left, right = number(form[1]), number(form[2])
        return {
            "<=": lambda: left <= right + tolerance,
            ">=": lambda: left >= right - tolerance,
            "<": lambda: left < right + tolerance,
            ">": lambda: left > right - tolerance,
            "==": lambda: abs(left - right) <= tolerance,
            "!=": lambda: abs(left - right) > tolerance,
        }[form[0]]()

    for credit, tolerance in ((2, 0.0), (1, 1e-4)):
        if all(true(form, tolerance if tensors(form) == {"X"} else 0.0) for form in assertions):
            return credit
    return 0


def printed(form):
    if isinstance(form, str):
        return form
    parts = form[1] if len(form) == 2 else form[1:]
    return f"({form[0]} {' '.join(printed(part) for part in parts)})"


element = st.sampled_from(["X_0", "X_1", "Y_0", "Y_1"])
# Multiples of 1/2 up to 1, and products of two of them: all of this is exact in float32.
product = st.tuples(st.just("*"), st.lists(element | exact_bound, min_size=1, max_size=2))
term = (
    element
    | exact_bound
    | st.tuples(
        st.sampled_from("+-"), st.lists(element | exact_bound | product, min_size=1, max_size=3)
    )
)
relation = st.sampled_from(["<=", ">=", "<", ">", "==", "!="])
comparison = st.tuples(relation, term, term)
bound_on_input = st.tuples(relation, st.sampled_from(["X_0", "X_1"]), exact_bound)
formula = st.recursive(
    comparison | bound_on_input,
    lambda inner: st.tuples(
        st.sampled_from(["and", "or"]), st.lists(inner, min_size=1, max_size=3)
    ),
    max_leaves=6,
)


#: Neither these nor their differences are near the end of the tolerance, which is rounded there.
apart = st.sampled_from([sign * size for size in (0, 1e-9, 4e-5, 2e-4) for sign in (1, -1)])


@settings(max_examples=200)
@given(
    st.lists(formula, min_size=1, max_size=3),
    st.lists(st.tuples(st.sampled_from(GRID), apart), min_size=2, max_size=2),
)
def test_2_0_agrees_where_float32_is_exact(assertions, start):
    exact = not any(
        operator in printed(form) for form in assertions for operator in ("(+", "(-", "(*")
    )
    x = [grid + (near if exact else 0.0) for grid, near in start]
    query = read(query_2(2, 2, *(printed(form) for form in assertions)))
    found = judge_witness(query, NETWORK, "n", witness_2(x, [0.0, 0.0]))
    values = [np.float32(v) for v in x]
    theirs = vnncomp_2(assertions, values, outputs(values))
    assert CREDIT.get(found.outcome, 0) == theirs

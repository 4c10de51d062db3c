"""The checker's reader against the harness's: the same points fulfil a question."""

import gzip
import sys
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from checker.files import Unreadable
from checker.query.vnnlib import read_question
from harness.query.evaluate import evaluate
from harness.query.read import read_query

sys.path.insert(0, str(Path(__file__).parents[2] / "harness"))
from query_helpers import PUBLISHED, query_1, query_2

NUMBERS = st.integers(-4, 4).map(lambda n: f"{n / 2}")
SUMS = st.sampled_from(["Y_0", "Y_1", "(* 2 Y_0)", "(- Y_1)", "(- Y_0 Y_1)", "(+ Y_0 Y_1 1.5)"])
ATOMS = st.one_of(
    st.tuples(st.sampled_from(["<=", ">="]), st.sampled_from(["X_0", "X_1"]), NUMBERS),
    st.tuples(st.sampled_from(["<=", ">=", "=="]), SUMS, NUMBERS),
    st.tuples(st.sampled_from(["<=", ">="]), NUMBERS, st.sampled_from(["X_0", "Y_1"])),
).map(lambda parts: f"({' '.join(parts)})")
FORMULAS = st.recursive(
    ATOMS,
    lambda inner: st.tuples(
        st.sampled_from(["and", "or"]), st.lists(inner, min_size=1, max_size=3)
    ).map(lambda parts: f"({parts[0]} {' '.join(parts[1])})"),
    max_leaves=8,
)
BOUNDS = ["(>= X_0 -2)", "(<= X_0 2.0)", "(>= X_1 -2)", "(<= X_1 2)"]


def fulfilled(question, inputs, outputs):
    """Whether some case of the checker's reading holds."""
    return any(
        all(a <= x <= b for a, x, b in zip(case.lower, inputs, case.upper, strict=True))
        and all(sum(f * outputs[i] for i, f in c.factors) <= c.most for c in case.conditions)
        for case in question.cases
    )


@settings(deadline=None)
@given(
    st.lists(FORMULAS, min_size=1, max_size=3),
    st.lists(st.lists(st.integers(-5, 5), min_size=4, max_size=4), min_size=1, max_size=8),
    st.sampled_from([query_1, query_2]),
)
def test_both_readers_mean_the_same(formulas, points, written):
    text = written(2, 2, *BOUNDS, *formulas)
    question, query = read_question(text, "text"), read_query(text, "text")
    assert (question.inputs, question.outputs) == (2, 2)
    for point in points:
        x0, x1, y0, y1 = (Fraction(n, 2) for n in point)
        held = evaluate(query, [[x0, x1], [y0, y1]]).holds
        assert fulfilled(question, [x0, x1], [y0, y1]) == held


def test_a_published_question_is_read_alike_in_both_versions():
    path = next(p for p in PUBLISHED if "missing1" in p.name and "1.0" in str(p))
    texts = [
        gzip.decompress((path.parents[1] / version / path.name).read_bytes()).decode()
        for version in ("1.0", "2.0")
    ]
    first, second = (read_question(text, "text") for text in texts)
    assert first == second
    assert len(first.cases) == 42


def test_a_strict_condition_is_read_as_not_strict_and_a_difference_as_nothing():
    (case,) = read_question(query_1(1, 1, "(>= X_0 0)", "(< X_0 1)", "(!= Y_0 2)"), "text").cases
    assert case.upper == (1,)
    assert case.conditions == ()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "(assert (<= X_0 1))",
        query_1(1, 1, "(<= X_0 1)", "(<= Y_0 0)"),
        query_1(1, 1, "(<= X_0 1)", "(>= X_0 0)", "(<= (* Y_0 Y_0) 0)"),
        query_1(1, 1, "(<= X_0 1)", "(>= X_0 0)", "(implies (<= Y_0 0) (<= Y_0 1))"),
        query_1(1, 1, "(<= X_0 1)", "(>= X_0 0)", "(<= Y_1 0)"),
        query_1(1, 1, "(<= X_0 1)") + ")",
        query_1(1, 1, "(<= X_0 1)", "(>= X_0 0)", "[(<= Y_0 0)"),
        query_1(1, 1, "(<= X_0 1)") + "(assert (<= Y_0 0)",
        query_1(1, 1, "(<= X_0 1e9999)", "(>= X_0 0)"),
    ],
)
def test_what_is_not_known_is_refused(text):
    with pytest.raises(Unreadable):
        read_question(text, "text")


def test_too_many_cases_are_refused():
    many = ["(or (<= Y_0 0) (>= Y_0 1))"] * 20
    with pytest.raises(Unreadable, match="cases"):
        read_question(query_1(1, 1, "(<= X_0 1)", "(>= X_0 0)", *many), "text")

"""Queries are read as they are written, or one line says what is wrong in which line."""

from fractions import Fraction
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from query_helpers import PUBLISHED, query_1, query_2, read
from vnnlib_reader import Read

import vnnlib
from harness.query.evaluate import evaluate
from harness.query.network import read_unpacked
from harness.query.read import NotUnderstood, comparisons, read_query
from harness.query.terms import Comparison, Element, Operation, Or, Relation
from racecar.errors import BadInput

WHOLE = "(vnnlib-version <2.0>)\n(declare-network N\n(declare-input X float32 [2,3])\n(declare-output Y float32 [1])\n)\n"  # noqa: E501


def test_comparison_in_1_0():
    query = read(query_1(2, 1, "(<= X_1 0.1)", "(>= Y_0 -1e-3)"))
    assert query.version == "1.0"
    assert [(t.name, t.shape, t.is_input) for t in query.tensors] == [
        ("X", (2,), True),
        ("Y", (1,), False),
    ]
    first, second = query.assertions
    tenth = Fraction(1, 10)  # exactly, not the double
    assert first == Comparison(Relation.AT_MOST, Element(0, 1), tenth, 4, True, True)
    assert second.right == Fraction(-1, 1000)
    assert (second.on_inputs, second.tolerant) == (False, False)


def test_elements_in_2_0_are_row_major():
    query = read(WHOLE + "(assert (<= X[1,0] X [0, 2]))\n(assert (> (* 2.0 Y[0]) (- 1.0)))")
    first, second = query.assertions
    assert (first.left, first.right) == (Element(0, 3), Element(0, 2))
    assert second.left == Operation("*", (Fraction(2), Element(1, 0)))
    assert second.right == Operation("-", (Fraction(1),))
    assert [t.shape for t in query.tensors] == [(2, 3), (1,)]


def test_tolerance_is_for_inputs_alone():
    mixed = "(or (and (<= X_0 1.0) (<= Y_0 0.0)) (and (>= X_0 2.0) (<= Y_0 0.0)))"
    one, two = read(query_1(1, 1, mixed)), read(query_2(1, 1, mixed))
    assert isinstance(one.assertions[0], Or)
    by_comparison = [c.tolerant for c in comparisons(one.assertions[0])]
    assert by_comparison == [True, False, True, False]
    # For 2.0 VNN-COMP decides for a whole assertion.
    assert not any(c.tolerant for c in comparisons(two.assertions[0]))
    assert read(query_2(1, 1, "(or (<= X_0 1.0) (>= X_0 2.0))")).assertions[0].parts[0].tolerant
    assert not read(query_1(1, 1, "(<= 1.0 2.0)")).assertions[0].tolerant


def test_comments_and_lines():
    text = "; a (comment\n" + query_1(1, 1, "(or\n (<= X_0 1.0) ; inside\n (<= Y_0 2.0))")
    assert [c.line for c in comparisons(read(text).assertions[0])] == [5, 6]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "query: it holds no VNN-LIB"),
        ("x", "query, line 1: 'x' stands outside parentheses"),
        ("(a\n(b", "query, line 2: this parenthesis is never closed"),
        ("(a)\n)", "query, line 2: a closing parenthesis too many"),
        ("(" * 200, "query, line 1: nested deeper than 100 levels"),
        ("(declare-const X_1 Real)", "line 1: X_1 is declared where X_0 must be"),
        ("(declare-const Z_0 Real)", "line 1: it must read (declare-const X_0 Real), X or Y"),
        ("(declare-const X_0 Real)\n(assert (<= X_0 1))", "it must declare inputs and outputs"),
        (query_1(1, 1), "it asserts nothing"),
        (query_1(1, 1, "(<= X_0 abc)"), "line 3: 'abc' is neither a number nor declared"),
        (query_1(1, 1, "(<= X_1 0.0)"), "line 3: 'X_1' is neither a number nor declared"),
        (query_1(1, 1, "(<= X_0 1e9999)"), "line 3: '1e9999' is neither a number"),
        (query_1(1, 1, "(<= X_0 nan)"), "line 3: 'nan' is neither"),
        (query_1(1, 1, "(<= X_0 " + "1" * 2000 + ")"), "is neither a number nor declared"),
        (query_1(1, 1, "(<= X_0)"), "line 3: <= compares two terms, not 1"),
        (query_1(1, 1, "(not (<= X_0 1.0))"), "line 3: 'not' is none of and, or, <="),
        (query_1(1, 1, "(or)"), "line 3: (or) joins nothing"),
        (query_1(1, 1, "X_0"), "line 3: 'X_0' is not a condition"),
        (query_1(1, 1, "(<= (/ X_0 2.0) 1.0)"), "line 3: '/' is none of +, - and * with terms"),
        (query_1(1, 1, "(<= X_0 1.0)") + "(check-sat)", "line 4: it must read (assert ...)"),
        ("(vnnlib-version <3.0>)", "version <3.0> is not known"),
        ("(vnnlib-version <2.0>)\n(assert (<= X[0] 1.0))", "one network must be declared"),
        (WHOLE + "(assert (<= X[2,0] 1.0))", "line 6: X[2,0] is not in shape [2, 3]"),
        (WHOLE + "(assert (<= X[0] 1.0))", "line 6: X[0] is not in shape [2, 3]"),
        (WHOLE + "(assert (<= Z[0] 1.0))", "line 6: 'Z[0]' is neither a number nor declared"),
        (WHOLE.replace("Y float32", "X float32"), "line 2: a name is declared twice"),
        (WHOLE.replace("[1]", "[0]"), "line 4: [0] is not a shape"),
    ],
)
def test_errors_say_where(text, message):
    with pytest.raises(BadInput) as caught:
        read(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        WHOLE + WHOLE.partition("\n")[2].replace(" N", " M"),
        WHOLE.replace("(declare-output", '(declare-hidden H float32 [1] "h")\n(declare-output'),
        WHOLE.replace("(declare-input", "(equal-to M)\n(declare-input"),
        WHOLE.replace("float32 [2,3]", "int64 [2,3]"),
    ],
)
def test_rest_of_2_0_is_not_understood(text):
    with pytest.raises(NotUnderstood):
        read(text + "(assert (<= Y[0] 1.0))")


ASSERTIONS = [
    "(<= X[0,0] 1.0)", "(>= 0.5 X[0, 0])", "(< X [0,0] -1.25)", "(> X[0,0] X[0,1])",
    "(== X[0,0] 1.0)", "(!= X[0,0] 1.0)", "(<= 1.0 2.0)", "(= X[0,0] 1.0)", "(=> X[0,0] 1.0)",
    "(<= (+ X[0,0] X[0,1] Y[0,0]) 1.0)", "(<= (- X[0,0]) 1.0)", "(<= (- X[0,0] 2.0 3.0) 1.0)",
    "(<= (* 2.0 X[0,0] X[0,1]) 1.0)", "(<= (+ X[0,0]) 1.0)", "(<= (/ X[0,0] 2.0) 1.0)",
    "(or (<= X[0,0] 1.0))", "(and (or (<= X[0,0] 1.0) (<= Y[0,0] 2.0)) (>= Y[0,0] 0.0))",
    "(and)", "(not (<= X[0,0] 1.0))", "true", "(<= X[0,2] 1.0)", "(<= X[0] 1.0)", "(<= X_0 1.0)",
    "(<= Z[0,0] 1.0)", "(<= X[0,0] 1.0 2.0)", "(<= X[0,0])",
]  # fmt: skip


@pytest.mark.parametrize("assertion", ASSERTIONS)
def test_the_official_parser_takes_what_we_take(assertion):
    text = query_2(2, 1, assertion)
    try:
        vnnlib.parse_query_string(text)
    except vnnlib.VNNLibException:
        with pytest.raises(BadInput):
            read(text)
    else:
        read(text)


SMALL = [path for path in PUBLISHED if path.stat().st_size < 20_000][::60]


@cache
def read_twice(path):
    text = read_unpacked(path).decode()
    other = Read(text)
    return read_query(text, path.name), other, other.boxes()


@pytest.mark.parametrize("path", SMALL, ids=lambda path: f"{path.parent.name}-{path.stem}")
@settings(max_examples=20)
@given(data=st.data())
def test_published_files_mean_what_another_reader_says(path, data):
    query, other, boxes = read_twice(path)
    assert [t.size for t in query.tensors] == [other.inputs, other.outputs]
    numbers = st.sampled_from([Fraction(x) for x in other.numbers])
    x = [
        data.draw(st.sampled_from([low, high, (low + high) / 2, low - 1]))
        for low, high in data.draw(st.sampled_from(boxes))
    ]
    y = [data.draw(numbers | st.just(Fraction(0))) for _ in range(other.outputs)]
    assert evaluate(query, [x, y]).holds == other.holds(x, y)


def test_every_published_file_can_be_read():
    assert len(PUBLISHED) > 500
    pairs = {}
    for path in PUBLISHED[::15]:
        query = read_query(read_unpacked(path).decode(), path.name)
        pairs.setdefault(path.stem, []).append(query.version)
        assert query.version == path.parent.name
    assert pairs

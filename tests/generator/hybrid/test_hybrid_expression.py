"""Expressions: exact numbers, and text that two grammars read alike."""

import re
from fractions import Fraction

import pytest
from hybrid_readers import FLOWSTAR_NUMBER, Parser, Refused, read_expression
from hypothesis import given
from hypothesis import strategies as st

from generator.hybrid.expression import (
    Call,
    Constant,
    Difference,
    Dot,
    Negative,
    Power,
    Product,
    Quotient,
    Sum,
    Variable,
    constant,
    evaluate,
    is_polynomial,
    names_in,
    renamed,
)
from generator.hybrid.text import infix, number

HYST = {"numbers": re.compile(r"(?:\d+(?:\.\d+)?|\.\d+)(?:[Ee][+|-]?\d+)?"), "minus_first": True}
X, Y = Variable("x"), Variable("y")

finite = st.floats(allow_nan=False, allow_infinity=False)
#: Multiples of 1/4: sums and products of a few are exact doubles.
quarters = st.integers(-40, 40).map(lambda n: n / 4)
leaves = quarters.map(Constant) | st.sampled_from([X, Y])
weights = st.lists(quarters, min_size=0, max_size=3)


def _nodes(inner):
    return (
        st.builds(Sum, inner, inner)
        | st.builds(Difference, inner, inner)
        | st.builds(Product, inner, inner)
        | st.builds(Negative, inner)
        | st.builds(Power, inner, st.integers(2, 3))
        | weights.flatmap(
            lambda w: st.builds(Dot, st.just(tuple(w)), st.tuples(*[inner for _ in w]), quarters)
        )
    )


trees = st.recursive(leaves, _nodes, max_leaves=8)


def exact(node, values):
    """Return the exact value of a tree, written here from the nodes' docstrings."""
    match node:
        case Constant(value):
            return Fraction(value)
        case Variable(name):
            return values[name]
        case Sum(a, b):
            return exact(a, values) + exact(b, values)
        case Difference(a, b):
            return exact(a, values) - exact(b, values)
        case Product(a, b):
            return exact(a, values) * exact(b, values)
        case Negative(a):
            return -exact(a, values)
        case Power(a, n):
            return exact(a, values) ** n
        case Dot(w, terms, bias):
            pairs = zip(w, terms, strict=True)
            return sum((Fraction(x) * exact(t, values) for x, t in pairs), Fraction(bias))
    raise AssertionError(node)


def read_exactly(text, values, **options):
    """Read text and compute it in fractions; numbers are the doubles that are printed."""
    source = read_expression(text, **options)
    source = re.sub(r"\((\d+\.?\d*(?:e[+-]?\d+)?|-\d+\.?\d*(?:e[+-]?\d+)?)\)", r"(F(\1))", source)
    return eval(source, {"F": Fraction, "v": values})


@given(trees, st.integers(-3, 3), st.integers(-3, 3))
def test_both_grammars_read_the_text_as_the_tree(tree, x, y):
    values = {"x": Fraction(x), "y": Fraction(y)}
    text = infix(tree)
    wanted = exact(tree, values)
    assert read_exactly(text, values) == wanted  # Flow*
    assert read_exactly(text, values, **HYST) == wanted  # SpaceEx as Hyst reads it


@given(trees, quarters, quarters)
def test_evaluation_is_close_to_exact(tree, x, y):
    values = {"x": Fraction(x), "y": Fraction(y)}
    wanted = exact(tree, values)
    got = evaluate(tree, {"x": x, "y": y})
    size = exact(_positive(tree), {"x": abs(values["x"]), "y": abs(values["y"])})
    assert abs(Fraction(got) - wanted) <= size * Fraction(1, 10**12)


def _positive(node):
    """Return the tree with every sign positive: it bounds every value on the way."""
    match node:
        case Constant(value):
            return Constant(abs(value))
        case Sum(a, b) | Difference(a, b):
            return Sum(_positive(a), _positive(b))
        case Product(a, b):
            return Product(_positive(a), _positive(b))
        case Negative(a):
            return _positive(a)
        case Power(a, n):
            return Power(_positive(a), n)
        case Dot(w, terms, bias):
            return Dot(tuple(map(abs, w)), tuple(map(_positive, terms)), abs(bias))
    return node


@given(trees, trees, quarters, quarters)
def test_operators_mean_what_they_say(a, b, x, y):
    values = {"x": Fraction(x), "y": Fraction(y)}
    left, right = exact(a, values), exact(b, values)
    assert exact(a + b, values) == left + right
    assert exact(a - b, values) == left - right
    assert exact(a * b, values) == left * right
    assert exact(-a, values) == -left
    assert exact(a**2, values) == left**2
    assert exact(2.5 * a - 1.0, values) == left * Fraction(5, 2) - 1


@given(finite)
def test_a_number_reads_back_as_the_same_double_in_both_lexers(value):
    text = number(value)
    assert float(text) == value
    assert "E" not in text
    assert "+" not in text
    assert FLOWSTAR_NUMBER.fullmatch(text)
    assert HYST["numbers"].fullmatch(text.removeprefix("-"))


def test_nothing_is_rounded_or_folded_but_zeros_and_ones():
    assert infix(constant(0.225) + 0.225 - 1.0) == "0.225 + 0.225 - 1.0"
    assert infix(1.0 * X + 0.0 * Y - 0.3) == "x - 0.3"
    assert infix(-1.0 * X + 1.5) == "1.5 - x"
    assert infix(0.1 * X * Y) == "0.1 * x * y"


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        (Difference(Y, Constant(0.3)), "y - 0.3"),
        (Sum(Y, Constant(-0.3)), "y + (-0.3)"),
        (Negative(Power(X, 2)), "-(x^2)"),
        (Product(X, Negative(Y)), "x * (-y)"),
        (Difference(X, Difference(Y, X)), "x - (y - x)"),
        (Quotient(X, Product(X, Y)), "x / (x * y)"),
        (Power(Negative(X), 3), "(-x)^3"),
        (Dot((-2.0, 0.0, 0.5), (X, Y, Y), -1e-05), "-2.0 * x + 0.5 * y - 1e-05"),
        (Dot((0.0,), (X,), 0.0), "0.0"),
        (Call("sin", Sum(X, Y)), "sin(x + y)"),
    ],
)
def test_traps_of_the_grammars_are_avoided(tree, text):
    assert infix(tree) == text


def test_a_minus_that_touches_digits_would_be_no_difference():
    # The reader knows the trap, so that the tests above could fall into it.
    with pytest.raises(Refused):
        read_expression("y -0.3")
    with pytest.raises(Refused):
        read_expression("2.0E5")
    assert Parser("2.5e-05").kind() == "number"


def test_polynomials_names_and_renaming():
    tree = Dot((1.0, 2.0), (Product(X, Y), Power(X, 2)), 3.0)
    assert is_polynomial(tree)
    assert names_in(tree) == {"x", "y"}
    assert infix(renamed(tree, {"x": "s"})) == "1.0 * (s * y) + 2.0 * s^2 + 3.0"
    for strange in (Quotient(X, Y), Call("tanh", X)):
        assert not is_polynomial(Sum(tree, strange))
        assert names_in(renamed(strange, {"x": "z"})) <= {"z", "y"}

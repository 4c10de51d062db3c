import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from generator.openloop.numbers import at_least, at_most, nearest, plain

floats = st.floats(width=32, allow_nan=False, allow_infinity=False)
numbers = st.one_of(
    st.fractions(min_value=-1000, max_value=1000),
    st.decimals(min_value=-50, max_value=50, places=9, allow_nan=False).map(Fraction),
    st.floats(min_value=-1e30, max_value=1e30).map(Fraction),
    floats.map(Fraction),
)


def neighbours(value):
    below, above = (np.nextafter(value, np.float32(x)) for x in (-np.inf, np.inf))
    return Fraction(float(below)), Fraction(float(above))


@given(floats)
def test_a_decimal_is_exactly_its_float32(value):
    text = plain(np.float32(value))
    assert re.fullmatch(r"-?\d+\.\d+", text)
    assert Fraction(text) == Fraction(value)
    assert np.float32(text) == np.float32(value)
    assert text not in ("-0.0",)


@given(numbers.filter(lambda x: abs(x) < 10**30))
def test_rounding_inwards_never_crosses_the_bound_and_goes_no_further_than_needed(value):
    low, high = at_least(value), at_most(value)
    assert isinstance(low, np.float32)
    assert isinstance(high, np.float32)
    assert neighbours(low)[0] < value <= Fraction(float(low))
    assert Fraction(float(high)) <= value < neighbours(high)[1]


@given(numbers.filter(lambda x: abs(x) < 10**30))
def test_nearest_has_no_nearer_neighbour(value):
    found = nearest(value)
    distance = abs(Fraction(float(found)) - value)
    below, above = neighbours(found)
    assert distance <= abs(below - value)
    assert distance <= abs(above - value)


def test_a_number_just_beside_the_middle_of_two_neighbours_is_not_rounded_twice():
    # Half way between 1 and the next float32, and a little more than a double can tell.
    middle = 1 + Fraction(1, 2**24)
    assert nearest(middle + Fraction(1, 2**80)) == np.float32(1) + np.float32(2**-23)
    assert nearest(middle - Fraction(1, 2**80)) == np.float32(1)
    assert nearest(middle) == np.float32(1)  # ties to even


def test_what_is_not_finite_has_no_decimal():
    with pytest.raises(ValueError, match="no decimal"):
        plain(np.float32("inf"))

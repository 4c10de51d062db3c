"""Lines below and above activations: against Arb, at many places of many intervals."""

import numpy as np
import pytest
from flint import arb
from hypothesis import given
from hypothesis import strategies as st

from checker.query import lines
from checker.tanh import TANH_ERROR, tanh

ENDS = st.floats(-30, 30)
VALUES = {
    "tanh": (lines.tanh_lines, lambda y: y.tanh()),
    "sigmoid": (lines.sigmoid_lines, lambda y: (1 + (y / 2).tanh()) / 2),
    "relu": (lines.relu_lines, lambda y: y.max(arb(0))),
    "none": (lines.linear_lines, lambda y: y),
}


@given(st.floats(-50, 50))
def test_tanh_errs_by_no_more_than_it_says(x):
    found = float(tanh(np.array([x]))[0])
    assert abs(arb(x).tanh() - arb(found)) <= TANH_ERROR


@pytest.mark.parametrize("name", VALUES)
@given(a=ENDS, b=ENDS, shares=st.lists(st.floats(0, 1), min_size=1, max_size=8), near=st.booleans())
def test_lines_hold_everywhere(name, a, b, shares, near):
    low, high = min(a, b), max(a, b)
    if near:
        high = low + (high - low) * 1e-9
    found, value = VALUES[name]
    below, drop, above, rise = (arb(float(x[0])) for x in found(np.array([low]), np.array([high])))
    places = {0.0, low, high, *(low + share * (high - low) for share in shares)}
    for x in (x for x in places if low <= x <= high):
        y = value(arb(x))
        assert below * arb(x) + drop <= y
        assert above * arb(x) + rise >= y


@given(st.floats(-3, 3), st.floats(1e-6, 1e-3))
def test_lines_are_close_on_small_intervals(low, width):
    """tanh'' is below 0.77: two lines need not be farther apart than 0.77 width^2."""
    high = low + width
    below, drop, above, rise = (x[0] for x in lines.tanh_lines(np.array([low]), np.array([high])))
    for x in (low, high):
        assert (above - below) * x + rise - drop <= 0.8 * width**2 + 1e-12


def test_what_is_not_finite_is_not_bounded():
    low, high = np.array([-np.inf, 0.0, np.nan]), np.array([0.0, np.inf, 1.0])
    with np.errstate(all="ignore"):
        below, drop, above, rise = lines.tanh_lines(low, high)
    assert not (np.isfinite(drop) & np.isfinite(rise) & np.isfinite(below + above)).any()

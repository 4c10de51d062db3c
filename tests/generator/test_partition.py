from decimal import Decimal
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from generator.partition import Partition, exact_decimal, tile
from racecar.errors import BadInput


@pytest.mark.parametrize(("width", "count"), [("0.005", 40), ("0.002", 100), ("0.001", 200)])
def test_the_start_range_is_tiled_without_gap(width, count):
    subsets = tile("0.65", "0.85", width)
    assert len(subsets) == count
    assert Decimal(subsets[0][0]) == Decimal("0.65")
    assert Decimal(subsets[-1][1]) == Decimal("0.85")
    for low, high in subsets:
        assert Decimal(high) - Decimal(low) == Decimal(width)
        assert float(low) < float(high)


@given(
    low=st.decimals(-100, 100, places=4),
    width=st.decimals("0.0001", 2, places=4),
    count=st.integers(1, 300),
)
def test_neighbours_share_one_number_and_widths_sum_to_the_range(low, width, count):
    high = low + count * width
    subsets = tile(str(low), str(high), str(width))
    assert len(subsets) == count
    assert sum(Decimal(b) - Decimal(a) for a, b in subsets) == high - low
    for (_, right), (left, _) in pairwise(subsets):
        assert right == left  # the literal, hence the decimal number and the double
    for a, b in subsets:
        assert Decimal(repr(float(a))) == Decimal(a)
        assert Decimal(repr(float(b))) == Decimal(b)
    assert (Decimal(subsets[0][0]), Decimal(subsets[-1][1])) == (low, high)


@pytest.mark.parametrize(
    ("lower", "upper", "width"),
    [
        ("0.65", "0.85", "0.003"),
        ("0.65", "0.85", "0"),
        ("0.65", "0.85", "-0.005"),
        ("0.85", "0.65", "0.005"),
        ("0.65", "0.65", "0.005"),
    ],
)
def test_a_width_that_does_not_divide_the_range_is_refused(lower, upper, width):
    with pytest.raises(BadInput, match="does not divide"):
        tile(lower, upper, width)


@pytest.mark.parametrize("text", ["0.65", "6.5e-1", "-0.1", "0", "12345678901234", "1e-7"])
def test_decimals_that_a_double_keeps_are_exact(text):
    assert exact_decimal(text) == Decimal(text)


@pytest.mark.parametrize("text", ["", "x", "0,65", "nan", "inf", "-Infinity", "1e400", "0x1p0"])
def test_what_is_not_a_finite_decimal_is_refused(text):
    with pytest.raises(BadInput):
        exact_decimal(text)


@pytest.mark.parametrize("text", ["0.65000000000000000001", "0.1000000000000000055511151231257827"])
def test_decimals_that_a_double_would_round_are_refused(text):
    with pytest.raises(BadInput, match="exactly"):
        exact_decimal(text)


def test_ids_number_the_subsets_of_a_partition_but_not_a_whole_range():
    parts = Partition("0.65", "0.85", "0.005", ("clearance",))
    assert parts.ids("C.closed_loop")[17] == ["C.closed_loop.w5mm.017.clearance"]
    assert parts.subsets[17] == ("0.735", "0.740")
    whole = Partition("0.65", "0.85", "0.2", ("clearance", "hscc20"))
    assert whole.ids("C.full_range") == [["C.full_range.clearance", "C.full_range.hscc20"]]

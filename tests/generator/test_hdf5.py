import io
import time

import h5py
import numpy as np
import pytest

from generator.hdf5 import Dataset, Group, differences, floats, text, to_bytes


def tree(shift=0.0, units="m"):
    inner = {
        "x": Dataset(floats([1.0, np.nan, 3.0]) + shift, units, "places"),
        "n": Dataset(np.arange(3), "1", "numbers"),
        "t": Dataset(text([["0.65", "0.655"]]), "m", "literals"),
    }
    return Group("all", {"g": Group("some", inner, {"sha256": "ab"})})


def test_what_was_written_reads_back_with_units_and_descriptions():
    with h5py.File(io.BytesIO(to_bytes(tree())), "r") as file:
        np.testing.assert_array_equal(file["g/x"][()], [1.0, np.nan, 3.0])
        assert file["g/t"][()].tolist() == [[b"0.65", b"0.655"]]
        assert file["g/x"].attrs["units"] == "m"
        assert file["g"].attrs["description"] == "some"
        assert file["g"].attrs["sha256"] == "ab"
        assert file.attrs["description"] == "all"


def test_the_same_tree_gives_the_same_bytes_a_second_later():
    first = to_bytes(tree())
    time.sleep(1.1)  # HDF5 counts modification times in seconds
    assert to_bytes(tree()) == first


def test_equal_content_has_no_differences():
    assert differences(to_bytes(tree()), to_bytes(tree()), 0.0) == []


def test_reals_may_differ_by_the_tolerance_and_no_more():
    assert differences(to_bytes(tree()), to_bytes(tree(shift=1e-10)), 1e-9) == []
    assert differences(to_bytes(tree()), to_bytes(tree(shift=1e-8)), 1e-9) == ["/g/x"]
    assert differences(to_bytes(tree()), to_bytes(tree(shift=1e-15)), 0.0) == ["/g/x"]


def test_other_attributes_members_types_and_damage_are_differences():
    one = to_bytes(tree())
    assert differences(one, to_bytes(tree(units="cm")), 1.0) == ["/g/x"]
    assert differences(one, to_bytes(Group("all", {"g": Group("some", {})})), 1.0) == [
        "/g",
        "/g/n",
        "/g/t",
        "/g/x",
    ]
    assert differences(one, one[:300], 1.0) == ["/"]
    assert differences(one, b"", 1.0) == ["/"]
    as_float = Group("all", {"x": Dataset(floats([1]), "1", "")})
    as_int = Group("all", {"x": Dataset(np.array([1]), "1", "")})
    assert differences(to_bytes(as_float), to_bytes(as_int), 1.0) == ["/x"]


@pytest.mark.parametrize("tolerance", [0.0, 1e-9])
def test_nan_equals_only_nan(tolerance):
    one = to_bytes(Group("", {"x": Dataset(floats([np.nan]), "m", "")}))
    other = to_bytes(Group("", {"x": Dataset(floats([0.0]), "m", "")}))
    assert differences(one, one, tolerance) == []
    assert differences(one, other, tolerance) == ["/x"]

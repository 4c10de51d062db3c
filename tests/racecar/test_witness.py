"""Witnesses: written and read back without loss, and refused with one clear line."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from racecar.errors import BadInput
from racecar.witness import Witness, format_witness, parse_witness

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
RAYS = st.lists(st.integers(0, 1080), max_size=5)
START = {"s": 0.7, "f": 9.9, "v": 0.0, "theta": 0.0}


@given(
    start=st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS),
    missing=st.none() | RAYS | st.lists(RAYS, min_size=1, max_size=4),
    noise=st.none() | st.lists(st.lists(NUMBERS, max_size=4), max_size=4),
    mirror=st.none() | st.integers(-3, 99),
)
def test_reading_gives_back_what_was_written(start, missing, noise, mirror):
    s, f, v, theta = start
    witness = Witness(s=s, f=f, v=v, theta=theta, missing=missing, noise=noise, mirror=mirror)
    text = format_witness(witness)
    assert parse_witness(text) == witness
    assert text.count("\n") == 1
    data = json.loads(text)
    assert ("missing" in data, "noise" in data) == (missing is not None, noise is not None)
    assert ("mirror" in data) == (mirror is not None)


@pytest.mark.parametrize(
    ("missing", "lists", "per_step"),
    [
        (None, [], False),
        ([], [], False),
        ([3, 1], [[3, 1]], False),
        ([[3], [], [1, 2]], [[3], [], [1, 2]], True),
        ([[], []], [[], []], True),
    ],
)
def test_missing_rays_are_lists_for_the_run_or_for_each_step(missing, lists, per_step):
    witness = Witness(**START, missing=missing)
    assert witness.missing_lists == lists
    assert witness.missing_per_step == per_step


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "EOF"),
        ("[]", "valid object|object"),
        (json.dumps({"s": 0.7}), "f: Field required"),
        (json.dumps(START | {"why": 1}), "why: "),
        (json.dumps(START | {"missing": 3}), "missing"),
        (json.dumps(START | {"missing": [1.0]}), "missing.run.0: "),
        (json.dumps(START | {"missing": [True]}), "missing.run.0: "),
        (json.dumps(START | {"missing": [[1], 2]}), "missing.step.1: "),
        (json.dumps(START | {"missing": [[[1]]]}), "missing.step.0.0: "),
        (json.dumps(START | {"noise": [0.1]}), "noise.0: "),
        (json.dumps(START | {"noise": [["0.1"]]}), "noise.0.0: "),
        (json.dumps(START | {"noise": [[float("nan")]]}), "noise.0.0: "),
        (json.dumps(START | {"noise": [[None]]}), "noise.0.0: "),
        (json.dumps(START | {"mirror": 1.0}), "mirror: "),
        (json.dumps(START | {"mirror": [1]}), "mirror: "),
        (json.dumps(START | {"mirror": True}), "mirror: "),
        ('{"s": 0.7, "f": 9, "v": 0, "theta": 0, "s": 0.3}', 'the key "s" is given twice'),
        ('{"s": 0.7, "f": 9, "v": 0, "theta": 0, "\\u0073": 0.3}', 'the key "s" is given twice'),
        ("[" * 100_000, "recursion"),
    ],
)
def test_what_is_no_witness_is_refused_in_one_line(text, message):
    with pytest.raises(BadInput, match=message) as caught:
        parse_witness(text)
    assert "\n" not in str(caught.value)

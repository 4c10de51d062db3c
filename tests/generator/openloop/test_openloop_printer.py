from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vnnlib_reader import NUMBER, Read

from generator.openloop.printer import VERSIONS, print_spec
from generator.openloop.spec import Box, OutputBound, Spec

floats = st.floats(width=32, min_value=-8, max_value=8)


@st.composite
def boxes(draw, inputs):
    pairs = [sorted(draw(st.tuples(floats, floats))) for _ in range(inputs)]
    lower, upper = np.array(pairs, dtype=np.float32).T
    return Box(lower, upper)


@st.composite
def specs(draw):
    inputs, outputs = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    bound = st.builds(
        OutputBound,
        st.integers(0, outputs - 1),
        st.sampled_from(["<=", ">="]),
        floats.map(np.float32),
    )
    conjunction = st.lists(bound, min_size=1, max_size=3).map(tuple)
    return Spec(
        ("a comment (with brackets)", ""),
        tuple(draw(st.lists(boxes(inputs), min_size=1, max_size=4))),
        outputs,
        tuple(draw(st.lists(conjunction, min_size=1, max_size=4))),
    )  # fmt: skip


def meant(spec, x, y):
    """What a specification says, from its data alone."""
    inside = any(
        all(a <= v <= b for a, v, b in zip(box.lower.tolist(), x, box.upper.tolist(), strict=True))
        for box in spec.boxes
    )
    return inside and any(
        all(y[o.index] <= o.bound if o.relation == "<=" else y[o.index] >= o.bound for o in case)
        for case in spec.unsafe
    )


@settings(max_examples=40)
@given(specs(), st.data())
def test_both_versions_say_what_the_specification_means(spec, data):
    texts = [Read(print_spec(spec, version)) for version in VERSIONS]
    for text in texts:
        assert (text.inputs, text.outputs) == (spec.inputs, spec.outputs)
    for _ in range(5):
        # Points on and near the bounds tell most.
        box = data.draw(st.sampled_from(spec.boxes))
        x = [
            data.draw(st.sampled_from([a, b, (a + b) / 2, b + 1.0]))
            for a, b in zip(box.lower.tolist(), box.upper.tolist(), strict=True)
        ]
        known = [float(o.bound) for case in spec.unsafe for o in case]
        y = [
            data.draw(st.sampled_from([*known, *(b + 1e-6 for b in known), -9.0]))
            for _ in range(spec.outputs)
        ]
        for text in texts:
            assert text.holds(x, y) == meant(spec, x, y)


@settings(max_examples=60)
@given(specs())
def test_every_number_is_a_float32_without_exponent(spec):
    for version in VERSIONS:
        text = print_spec(spec, version)
        numbers = Read(text).numbers
        assert len(numbers) >= 2
        for number in numbers:
            assert NUMBER.fullmatch(number)
            assert Fraction(number) == Fraction(float(np.float32(number)))


@settings(max_examples=60)
@given(specs())
def test_the_official_parser_and_type_checker_take_version_2(spec):
    vnnlib = pytest.importorskip("vnnlib")
    query = vnnlib.parse_query_string(print_spec(spec, "2.0"))
    (network,) = query.networks
    (x,), (y,) = network.inputs, network.outputs
    assert (list(x.shape), list(y.shape)) == ([1, spec.inputs], [1, spec.outputs])


def test_bounds_that_all_boxes_share_are_stated_once():
    first = Box(np.array([0, 0], np.float32), np.array([1, 1], np.float32))
    second = Box(np.array([0, 0], np.float32), np.array([1, 2], np.float32))
    low, high = OutputBound(0, "<=", np.float32(-1)), OutputBound(0, ">=", np.float32(1))
    text = print_spec(Spec((), (first, second), 1, ((low,), (high,))), "1.0")
    assert text.splitlines()[-11:] == [
        "(assert (>= X_0 0.0))",
        "(assert (<= X_0 1.0))",
        "(assert (>= X_1 0.0))",
        "(assert (or",
        "  (and (<= X_1 1.0))",
        "  (and (<= X_1 2.0))",
        "))",
        "(assert (or",
        "  (and (<= Y_0 -1.0))",
        "  (and (>= Y_0 1.0))",
        "))",
    ]
    one = print_spec(Spec((), (first, second), 1, ((low,),)), "1.0").splitlines()[-4:]
    assert one == [
        "(assert (or",
        "  (and (<= X_1 1.0) (<= Y_0 -1.0))",
        "  (and (<= X_1 2.0) (<= Y_0 -1.0))",
        "))",
    ]


def test_a_box_that_holds_no_float32_and_an_empty_condition_are_refused():
    with pytest.raises(ValueError, match="lower bound"):
        Box.inside([Fraction("9.9")], [Fraction("9.9")])
    box = Box.inside([Fraction(0)], [Fraction(1)])
    with pytest.raises(ValueError, match="at least one"):
        Spec((), (box,), 1, ())
    with pytest.raises(ValueError, match="float32"):
        Box(np.zeros(1), np.ones(1))

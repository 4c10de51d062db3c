"""What is written in either syntax is what the judge of witnesses reads, to the last bit."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.counterexample import declared_tensors, is_version_2, write_counterexample
from harness.query.read import read_query
from harness.query.witness import read_inputs
from racecar.errors import BadInput

numbers = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=6)


def spec_1(inputs, outputs):
    declared = [f"(declare-const X_{i} Real)" for i in range(inputs)]
    declared += [f"(declare-const Y_{i} Real)" for i in range(outputs)]
    return "\n".join([*declared, "(assert (<= X_0 1.0))", "(assert (>= Y_0 0.0))"])


def spec_2(inputs, outputs):
    return f"""; (vnnlib-version <1.0>)
(vnnlib-version <2.0>)
(declare-network N
  (declare-input image real [1,{inputs}])
  (declare-output Y float32 [{outputs}])
)
(assert (<= image[0,0] 1.0))
(assert (>= Y[0] 0.0))
"""


@pytest.mark.parametrize("make_spec", [spec_1, spec_2])
@given(inputs=numbers, outputs=numbers)
def test_inputs_come_back_exactly(make_spec, inputs, outputs):
    spec = make_spec(len(inputs), len(outputs))
    text = write_counterexample(spec, inputs, outputs)
    (back,) = read_inputs(text.encode(), read_query(spec, "spec"))
    assert list(back) == inputs
    # VNN-COMP's own reader of 1.0 wants this and no other white space.
    if make_spec is spec_1:
        assert text.startswith("((X_0 ")
        assert text.endswith("))\n")


def test_versions_are_told_apart_by_the_header_alone():
    assert is_version_2(spec_2(1, 1))
    assert not is_version_2(spec_1(1, 1))
    assert not is_version_2("; (vnnlib-version <2.0>)\n" + spec_1(1, 1))


def test_tensors_are_read_in_order():
    found = declared_tensors(spec_2(3, 2))
    assert [(t.kind, t.name, t.type, t.shape, t.size) for t in found] == [
        ("input", "image", "real", (1, 3), 3),
        ("output", "Y", "float32", (2,), 2),
    ]


@pytest.mark.parametrize(("spec", "complaint"), [
    (spec_2(2, 1), "image has 2 values, the witness 1"),
    (spec_2(1, 2), "Y has 2 values, the witness 1"),
    (spec_2(1, 1).replace("output", "hidden"), "does not declare one input and one output"),
])  # fmt: skip
def test_other_sizes_are_refused(spec, complaint):
    with pytest.raises(BadInput, match=complaint):
        write_counterexample(spec, [1.0], [2.0])

"""What is written in either syntax is what the judge of witnesses reads, to the last bit."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.adapter import Question
from harness.counterexample import counterexample_for, write_counterexample
from harness.description import Format
from harness.query.read import read_query
from harness.query.witness import read_inputs
from harness.tiny import make_tiny
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
    query = read_query(spec, "spec")
    text = write_counterexample(query, inputs, outputs)
    (back,) = read_inputs(text.encode(), query)
    assert list(back) == inputs
    # VNN-COMP's own reader of 1.0 wants this and no other white space.
    if make_spec is spec_1:
        assert text.startswith("((X_0 ")
        assert text.endswith("))\n")


@pytest.mark.parametrize("format_", [Format.VNNLIB_1, Format.VNNLIB_2])
def test_versions_are_told_apart_by_the_header_alone(tmp_path, format_):
    spec = tmp_path / "a.vnnlib"
    text = spec_1(1, 1) if format_ is Format.VNNLIB_1 else spec_2(1, 1)
    spec.write_text(
        f"; (vnnlib-version <{'2.0' if format_ is Format.VNNLIB_1 else '1.0'}>)\n{text}"
    )
    assert Question("tiny", spec, spec).format() is format_


@pytest.mark.parametrize("format_", [Format.VNNLIB_1, Format.VNNLIB_2])
def test_outputs_are_those_of_the_network(tmp_path, format_):
    tiny = make_tiny(tmp_path, [format_], 1)[1].entry  # y = x0 - x1
    text = counterexample_for(tiny.onnx, tiny.spec, [1.0, 0.25])
    assert "0.75" in text
    with pytest.raises(BadInput, match="takes 2 inputs, the witness has 1"):
        counterexample_for(tiny.onnx, tiny.spec, [1.0])
    with pytest.raises(BadInput, match="too large"):
        counterexample_for(tiny.onnx, tiny.spec, [1e300, 0.0])

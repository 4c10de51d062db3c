"""Counterexamples of VNN-COMP 2026 are read; anything else is malformed, with a reason."""

import pytest
from query_helpers import query_1, query_2, read

from harness.given import Malformed
from harness.query.witness import read_inputs

ONE, TWO = read(query_1(2, 1, "(<= X_0 1.0)")), read(query_2(2, 1, "(<= X_0 1.0)"))


def values(text, query):
    return [x.tolist() for x in read_inputs(text, query)]


@pytest.mark.parametrize(
    "text",
    [
        b"((X_0 0.5)(X_1 -1e-3)(Y_0 7))",
        b"((X_0 0.5)\n(X_1 -1e-3)\n(Y_0 nan))",
        b" ( ( X_0\t.5 ) (Y_0 anything) (X_1 -0.001) ) \n",
        b"((X_0 0.5)(X_1 -1e-3))",
        b"((X_0 +0.5)(X_1 -1E-3)(Y_0 1)(Y_1 2)(Y_2 3))",
    ],
)
def test_1_0(text):
    assert values(text, ONE) == [[0.5, -1e-3]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"X_0 0.5", "not one s-expression"),
        (b"()", "it gives 0 inputs; there are 2"),
        (b"((X_0 0.5))", "it gives 1 inputs; there are 2"),
        (b"((X_0 1)(X_1 1)(X_2 1))", "it gives 3 inputs; there are 2"),
        (b"((X_1 1)(X_0 1))", "X_1 stands where X_0 must be"),
        (b"((X_0 1)(X_0 1))", "X_0 stands where X_1 must be"),
        (b"((X_0 nan)(X_1 1))", "X_0: 'nan' is not a finite number"),
        (b"((X_0 inf)(X_1 1))", "X_0: 'inf' is not a finite number"),
        (b"((X_0 1e999)(X_1 1))", "X_0: '1e999' is not a finite number"),
        (b"((X_0 1_0)(X_1 1))", "X_0: '1_0' is not a finite number"),
        (b"((X_0 " + b"1" * 5000 + b")(X_1 1))", "is not a finite number"),
        (b"((X_0 1)(X_1 1)) ((X_0 1)(X_1 1))", "is not (X_i number) or (Y_i number)"),
        (b"((X_0 1)(X_1 1)(Z_0 1))", "is not (X_i number) or (Y_i number)"),
        (b"((X_0 1 2)(X_1 1))", "is not (X_i number)"),
        (b"(" * 100_000 + b")", "is not (X_i number)"),
        (b"\xff\xfe", "it is not text"),
    ],
)
def test_1_0_malformed(text, message):
    with pytest.raises(Malformed) as caught:
        read_inputs(text, ONE)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    "text",
    [
        b"X float32 [1,2]\n0.5\n-1e-3\nY float32 [1,1]\n7\n",
        b"\n X  Float32 [1, 2] \r\n0.5\n\n-0.001\nY real [ 1 ,1]\nnan",
    ],
)
def test_2_0(text):
    assert values(text, TWO) == [[0.5, -1e-3]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"X float32 [1,2]\n1\n2", "Y is missing"),
        (b"X float32 [1,2]\n1", "X has 1 values; it must have 2"),
        (b"X float32 [2]\n1\n2\nY float32 [1,1]\n1", "stands where X float32 [1, 2] must be"),
        (b"X float32 [1,2\n1\n2\nY float32 [1,1]\n1", "stands where X float32 [1, 2] must be"),
        (b"X float32 [1,,2]\n1\n2\nY float32 [1,1]\n1", "stands where X float32 [1, 2] must be"),
        (b"X float64 [1,2]\n1\n2\nY float32 [1,1]\n1", "stands where X float32 [1, 2] must be"),
        (b"Y float32 [1,1]\n1\nX float32 [1,2]\n1\n2", "stands where X float32 [1, 2] must be"),
        (b"X float32 [1,2]\n1 2\n3\nY float32 [1,1]\n1", "value 0: '1 2' is not a finite number"),
        (b"X float32 [1,2]\nnan\n3\nY float32 [1,1]\n1", "value 0: 'nan' is not a finite number"),
        (b"X float32 [1,2]\n1\n2\nY float32 [1,1]\n1\n2", "'2' follows the last value"),
        (b"((X_0 1)(X_1 1)(Y_0 1))", "stands where X float32 [1, 2] must be"),
    ],
)
def test_2_0_malformed(text, message):
    with pytest.raises(Malformed) as caught:
        read_inputs(text, TWO)
    assert message in str(caught.value)

"""Witnesses of queries are judged on the network, exactly; tolerance credits and proves nothing."""

import gzip
import hashlib
import json
from decimal import Decimal

import numpy as np
import pytest
from harness_helpers import harness
from query_helpers import (
    REPOSITORY,
    linear_network,
    query_1,
    query_2,
    read,
    witness_1,
    witness_2,
)

from harness.checks import judge_entry
from harness.machine import versions
from harness.query.judge import check_query_witness, judge_witness
from harness.records import WitnessOutcome
from racecar.errors import BadInput

OUTCOME = WitnessOutcome
COPY = linear_network([[1.0]])
BOX = ("(>= X_0 0.0)", "(<= X_0 1.0)")


def judge(assertions, x, network=COPY, outputs=1, version=1):
    inputs = len(x)
    if version == 1:
        return judge_witness(
            read(query_1(inputs, outputs, *assertions)), network, "n", witness_1(x)
        )
    query = read(query_2(inputs, outputs, *assertions))
    return judge_witness(query, network, "n", witness_2(x, [0.0] * outputs))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("x", "outcome"),
    [
        (0.5, OUTCOME.CORRECT),
        (1.0, OUTCOME.CORRECT),
        (1.0 + 5e-5, OUTCOME.CORRECT_WITH_TOLERANCE),
        (1.0 + 2e-4, OUTCOME.OUT_OF_BOX),
        (0.4, OUTCOME.WRONG),
        (-5e-5, OUTCOME.WRONG),
        (-2e-4, OUTCOME.OUT_OF_BOX),
        (3e38, OUTCOME.OUT_OF_BOX),
        (1e39, OUTCOME.MALFORMED),
    ],
)
def test_outcomes_around_the_bounds(x, outcome, version):
    found = judge((*BOX, "(>= Y_0 0.5)"), [x], version=version)
    assert found.outcome is outcome
    if outcome in (OUTCOME.CORRECT, OUTCOME.CORRECT_WITH_TOLERANCE, OUTCOME.WRONG):
        fed = float(np.float32(x))
        assert found.violation == pytest.approx(fed - 0.5, abs=1e-12)
        assert found.outside == pytest.approx(max(fed - 1, -fed, 0), abs=1e-12)


@pytest.mark.parametrize("version", [1, 2])
def test_outputs_have_no_tolerance(version):
    just = float(np.nextafter(np.float32(0.5), np.float32(0)))
    assert judge((*BOX, "(>= Y_0 0.5)"), [just], version=version).outcome is OUTCOME.WRONG


@pytest.mark.parametrize("version", [1, 2])
def test_float_trap(version):
    # The float32 nearest to 0.1 is above 0.1: fed to the network it is outside by 1.5e-9,
    # although it compares as equal when the bound is rounded, too.
    found = judge(("(>= X_0 0.0)", "(<= X_0 0.1)", "(>= Y_0 0.0)"), [0.1], version=version)
    assert found.outcome is OUTCOME.CORRECT_WITH_TOLERANCE
    assert found.outside == pytest.approx(float(np.float32(0.1)) - 0.1, rel=1e-6)
    below = float(np.nextafter(np.float32(0.1), np.float32(0)))
    found = judge(("(>= X_0 0.0)", "(<= X_0 0.1)", "(>= Y_0 0.0)"), [below], version=version)
    assert found.outcome is OUTCOME.CORRECT


def test_what_is_fed_counts_not_what_is_written():
    # 1 + 1e-9 is 1 in float32.
    assert judge((*BOX, "(>= Y_0 1.0)"), [1 + 1e-9]).outcome is OUTCOME.CORRECT


def test_double_network_gets_doubles():
    network = linear_network([[1.0]], np.float64)
    found = judge((*BOX, "(>= Y_0 0.0)"), [1 + 1e-9], network)
    assert found.outcome is OUTCOME.CORRECT_WITH_TOLERANCE


def test_witness_outputs_are_ignored():
    query = read(query_1(1, 1, *BOX, "(>= Y_0 0.5)"))
    for claimed in (-1e9, 1e9):
        found = judge_witness(query, COPY, "n", witness_1([0.75], [claimed]))
        assert (found.outcome, found.violation) == (OUTCOME.CORRECT, 0.25)
        found = judge_witness(query, COPY, "n", witness_1([0.25], [claimed]))
        assert (found.outcome, found.violation) == (OUTCOME.WRONG, -0.25)


def test_disjunction_of_boxes_names_the_nearest():
    boxes = "(or (and (>= X_0 0.0) (<= X_0 1.0))\n(and (>= X_0 2.0) (<= X_0 3.0)))"
    found = judge((boxes, "(>= Y_0 0.0)"), [1.75])
    assert (found.outcome, found.outside) == (OUTCOME.OUT_OF_BOX, 0.25)
    assert found.message == "an input lies 0.25 outside (line 4)"
    assert judge((boxes, "(>= Y_0 0.0)"), [2.0]).outcome is OUTCOME.CORRECT


def test_condition_must_be_met_in_the_box_that_the_input_is_in():
    both = "(or (and (<= X_0 1.0) (>= Y_0 5.0)) (and (>= X_0 2.0) (>= Y_0 0.0)))"
    assert judge((both,), [0.5]).outcome is OUTCOME.WRONG
    assert judge((both,), [0.5]).violation == -4.5
    assert judge((both,), [2.5]).outcome is OUTCOME.CORRECT
    assert judge((both,), [1.5]).outcome is OUTCOME.OUT_OF_BOX


def test_mixed_assertion_has_no_tolerance_in_2_0():
    both = "(or (and (<= X_0 1.0) (>= Y_0 0.0)) (and (>= X_0 2.0) (>= Y_0 0.0)))"
    assert judge((both,), [1.00005]).outcome is OUTCOME.CORRECT_WITH_TOLERANCE
    assert judge((both,), [1.00005], version=2).outcome is OUTCOME.OUT_OF_BOX


def test_bound_as_the_network_reads_it_is_credited_in_a_mixed_assertion():
    both = "(or (and (<= X_0 0.1) (>= Y_0 0.0)) (and (>= X_0 2.0) (>= Y_0 0.0)))"
    for version in (1, 2):
        assert judge((both,), [0.1], version=version).outcome is OUTCOME.CORRECT_WITH_TOLERANCE


def test_different_is_strict_or_by_the_tolerance():
    assertions = ("(!= X_0 1.0)", "(<= X_0 2.0)", "(>= Y_0 0.0)")
    assert judge(assertions, [1 + 5e-5], version=2).outcome is OUTCOME.CORRECT
    assert judge(assertions, [1.0], version=2).outcome is OUTCOME.OUT_OF_BOX
    # Where another bound needs the tolerance, it is to hold by the tolerance.
    near = ("(!= X_0 1.99995)", "(<= X_0 2.0)", "(>= Y_0 0.0)")
    assert judge(near, [2 + 4e-5], version=2).outcome is OUTCOME.OUT_OF_BOX
    assert judge(near, [2 + 9e-5], version=2).outcome is OUTCOME.CORRECT_WITH_TOLERANCE


@pytest.mark.parametrize("bound", ["1e39", "9" * 400, "-1e39", "-" + "9" * 400])
def test_bounds_beyond_float32(bound):
    found = judge((f"(<= X_0 {bound})", "(>= Y_0 0.0)"), [0.5])
    assert found.outcome is (OUTCOME.OUT_OF_BOX if bound[0] == "-" else OUTCOME.CORRECT)


def test_polynomials_are_exact():
    # 1 + 2^-23 squared needs 47 bits: in float32 the product rounds to 1 + 2^-22.
    x = 1 + 2.0**-23
    squared = format(Decimal(x * x), "f")  # exact in doubles
    at_least, more = f"(>= (* X_0 X_0) {squared})", f"(> (* X_0 X_0) {squared})"
    assert judge((at_least, "(>= Y_0 0.0)"), [x], version=2).outcome is OUTCOME.CORRECT
    assert judge((more, "(>= Y_0 0.0)"), [x], version=2).outcome is OUTCOME.CORRECT_WITH_TOLERANCE


def test_network_that_is_not_finite_proves_nothing():
    network = linear_network([[3e38, 3e38]])
    found = judge(("(<= X_0 10.0)", "(>= Y_0 1.0)"), [5.0], network, outputs=2)
    assert found.outcome is OUTCOME.WRONG
    assert found.message == "the network returned a value that is not finite"


@pytest.mark.parametrize(
    ("query", "network", "message"),
    [
        (query_1(2, 1, *BOX), COPY, "x has 1 elements, but X is declared with 2"),
        (query_1(1, 2, *BOX), COPY, "y has 1 elements, but Y is declared with 2"),
        (query_2(1, 1, *BOX), linear_network([[1.0]], np.float64), "X is declared as float32"),
        (query_1(1, 1, *BOX), b"no network", "onnxruntime cannot run it"),
    ],
)
def test_query_and_network_must_fit(query, network, message):
    with pytest.raises(BadInput, match=message):
        judge_witness(read(query), network, "net.onnx", witness_1([0.5]))


class TestFiles:
    @pytest.fixture
    def files(self, tmp_path):
        onnx, spec = tmp_path / "n.onnx", tmp_path / "q.vnnlib"
        onnx.write_bytes(COPY)
        spec.write_text(query_1(1, 1, *BOX, "(>= Y_0 0.5)"))
        return onnx, spec

    def test_check_names_its_files(self, files):
        onnx, spec = files
        text = witness_1([0.75])
        check = check_query_witness("id", onnx, spec, text)
        assert (check.instance, check.outcome) == ("id", OUTCOME.CORRECT)
        assert (check.violation, check.outside, check.margin) == (0.25, 0.0, None)
        assert check.message == "the outputs meet the condition by 0.25"
        for digest, content in (
            (check.witness_sha256, text),
            (check.spec_sha256, spec.read_bytes()),
            (check.onnx_sha256, onnx.read_bytes()),
        ):
            assert digest == hashlib.sha256(content).hexdigest()
        assert check.checked_with == versions()

    def test_gzipped_files_are_followed_whatever_they_are_called(self, files):
        plain = check_query_witness("id", *files, witness_1([0.75]))
        for path in files:
            path.write_bytes(gzip.compress(path.read_bytes()))
        check = check_query_witness("id", *files, witness_1([0.75]))
        assert check.outcome is OUTCOME.CORRECT
        # It is still the same question about the same network.
        assert (check.spec_sha256, check.onnx_sha256) == (plain.spec_sha256, plain.onnx_sha256)

    def test_broken_gzip_is_bad_input(self, files):
        files[0].write_bytes(gzip.compress(COPY)[:40])
        with pytest.raises(BadInput, match=r"n\.onnx: it is not a complete gzip file"):
            check_query_witness("id", *files, witness_1([0.75]))

    def test_missing_and_unsupported(self, files):
        assert check_query_witness("id", *files, b" \n").outcome is OUTCOME.MISSING
        files[1].write_text(query_2(1, 1, *BOX).replace("float32", "int8"))
        check = check_query_witness("id", *files, witness_1([0.75]))
        assert check.outcome is OUTCOME.UNSUPPORTED
        assert not check.credited


def sampled(id, version):
    """Return an entry, a corner that is a witness by another reader, outputs, X_0's upper bound."""
    import onnxruntime
    from vnnlib_reader import Read

    from harness.catalogue import select
    from harness.query.network import read_unpacked

    category = id.split(".")[1]
    path = next((REPOSITORY / "vnnlib" / category / version).glob(f"{id}.vnnlib*"))
    (entry,) = select(REPOSITORY / "benchmarks", [], [str(path)])
    query = Read(read_unpacked(path).decode())
    session = onnxruntime.InferenceSession(read_unpacked(entry.onnx))
    name = session.get_inputs()[0].name
    random = np.random.default_rng(0)
    for box in query.boxes():
        low, high = np.array(box, float).T
        for _ in range(300):
            x = np.where(random.random(len(low)) < 0.5, low, high).astype(np.float32)
            y = session.run(None, {name: x[None]})[0][0]
            if query.holds(x.tolist(), y.tolist()):
                return entry, x.tolist(), y.tolist(), high[0]
    raise AssertionError("no witness found")


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize(
    "id", ["TD3_L21_64x64_C1.open_loop.f2m.range1", "DDPG_L21_64x64_C1.unrolled.k2.left65deg"]
)
def test_published_instances_with_sampled_witnesses(id, version, tmp_path):
    entry, x, y, high = sampled(id, version)
    assert f"/{version}/" in entry.spec.as_posix()

    def written(x, y):
        return witness_1(x, y) if version == "1.0" else witness_2(x, y)

    def replayed(x, y):
        return judge_entry(entry, written(x, y))

    (tmp_path / "result").write_bytes(b"sat\n" + written(x, y))
    done = harness("replay", entry.spec, tmp_path / "result", "--json")
    assert (done.returncode, json.loads(done.stdout)["outcome"]) == (0, "correct")
    assert replayed(x, [0.0] * len(y)).outcome is OUTCOME.CORRECT
    outwards = 1 if x[0] == high else -1
    near = replayed([x[0] + outwards * 5e-5, *x[1:]], y)
    assert near.outcome is OUTCOME.CORRECT_WITH_TOLERANCE
    assert near.outside == pytest.approx(5e-5, rel=0.01)
    assert replayed([x[0] + 1.0, *x[1:]], y).outcome is OUTCOME.OUT_OF_BOX
    assert replayed(x[1:], y).outcome is OUTCOME.MALFORMED

"""verifier query: never against what sampling finds, witnesses that the judge accepts."""

from __future__ import annotations

import gzip
import itertools
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from checker.query.check import check
from harness.query.judge import judge_witness
from harness.query.read import read_query
from harness.records import WitnessOutcome
from racecar.errors import BadInput
from racecar.layers import Layer
from verifier.cli import main
from verifier.query.decide import decide
from verifier.query.lines import Lines

sys.path.insert(0, str(Path(__file__).parents[1] / "checker" / "query"))
sys.path.insert(0, str(Path(__file__).parents[1] / "harness"))
from asking import ACTIVATIONS, chain, computed, question, some_layers
from query_helpers import linear_network, query_1, query_2

REPOSITORY = Path(__file__).parents[2]
NAME = "TD3_L21_64x64_C1"


def files(folder, content, text):
    onnx, spec = folder / "net.onnx", folder / "q.vnnlib"
    onnx.write_bytes(content)
    spec.write_text(text)
    return onnx, spec


def judged(onnx, spec, witness):
    query = read_query(spec.read_text(), str(spec))
    return judge_witness(query, onnx.read_bytes(), str(onnx), witness.encode())


@settings(deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**32),
    kinds=st.tuples(*[st.sampled_from(ACTIVATIONS)] * 2),
    share=st.floats(-0.2, 0.4),
)
def test_answers_are_never_wrong(tmp_path_factory, seed, kinds, share):
    """share: how far thresholds lie beyond what a grid of the box reaches."""
    random = np.random.default_rng(seed)
    layers = some_layers(random, [2, 6, 5, 1], [*kinds, ""])
    lower = random.normal(size=2).astype(np.float32)
    upper = lower + random.uniform(size=2).astype(np.float32)
    axes = [np.linspace(a, b, 40) for a, b in zip(lower, upper, strict=True)]
    met = computed(layers, np.array(list(itertools.product(*axes))))
    least, most = float(met.min()), float(met.max())
    room = share * (most - least)
    ends = f"(or (<= Y_0 {least - room:.9f}) (>= Y_0 {most + room:.9f}))"
    folder = tmp_path_factory.mktemp("q")
    onnx, spec = files(folder, chain(layers), question(lower, upper, ends))
    answer = decide(onnx, spec, 1.0, folder / "c.h5")
    if answer.verdict == "sat":
        assert judged(onnx, spec, answer.witness).outcome is WitnessOutcome.CORRECT
    elif answer.verdict == "unsat":
        assert room > -1e-6  # else the grid has met a violation
        found = check(folder / "c.h5", spec, onnx)
        assert found.verdict == "valid"
        assert found.margin == pytest.approx(answer.margin_lower)


@pytest.mark.parametrize("write", [query_1, query_2])
def test_a_witness_has_the_form_of_its_version(tmp_path, write):
    text = write(2, 2, "(>= X_0 0)", "(<= X_0 1)", "(>= X_1 0)", "(<= X_1 1)",
                 "(>= Y_0 1.5)", "(<= Y_1 0.25)")  # fmt: skip
    onnx, spec = files(tmp_path, linear_network([[1, 1], [1, -1]]), text)
    answer = decide(onnx, spec, 5.0)
    assert answer.verdict == "sat"
    assert judged(onnx, spec, answer.witness).outcome is WitnessOutcome.CORRECT


def test_all_conditions_of_an_alternative_are_asked_for(tmp_path):
    """Each of both alone can be met: x + y >= 1.5 needs x >= 0.5, and then x - y >= -0.5."""
    text = query_1(2, 2, "(>= X_0 0)", "(<= X_0 1)", "(>= X_1 0)", "(<= X_1 1)",
                   "(>= Y_0 1.5)", "(<= Y_1 -0.6)")  # fmt: skip
    onnx, spec = files(tmp_path, linear_network([[1, 1], [1, -1]]), text)
    answer = decide(onnx, spec, 20.0, tmp_path / "c.h5")
    assert answer.verdict == "unsat"
    assert answer.leaves > 1
    assert check(tmp_path / "c.h5", spec, onnx).verdict == "valid"


def test_an_empty_box_is_unsat(tmp_path):
    text = query_1(1, 1, "(>= X_0 1)", "(<= X_0 0)", "(<= Y_0 0)")
    onnx, spec = files(tmp_path, linear_network([[1]]), text)
    assert decide(onnx, spec, 5.0, tmp_path / "c.h5").verdict == "unsat"
    assert check(tmp_path / "c.h5", spec, onnx).verdict == "valid"


def test_a_question_without_bounds_is_bad_input(tmp_path):
    onnx, spec = files(tmp_path, linear_network([[1]]), query_1(1, 1, "(<= X_0 0)", "(<= Y_0 0)"))
    with pytest.raises(BadInput, match="bounds"):
        decide(onnx, spec, 5.0)


def test_when_the_time_is_over_it_is_unknown(tmp_path):
    """The threshold is the maximum: no bound excludes it, and no input exceeds it."""
    layers = some_layers(np.random.default_rng(0), [3, 16, 1], ["Tanh", ""])
    lower, upper = -np.ones(3), np.ones(3)
    most = computed(layers, np.random.default_rng(1).uniform(-1, 1, size=(20000, 3))).max()
    text = question(lower, upper, f"(>= Y_0 {most + 0.3:.6f})", "(>= Y_0 0)")
    onnx, spec = files(tmp_path, chain(layers), text)
    answer = decide(onnx, spec, 1e-6, tmp_path / "c.h5")
    assert answer.verdict == "unknown"
    assert not (tmp_path / "c.h5").exists()


@given(
    seed=st.integers(0, 2**32), kinds=st.tuples(*[st.sampled_from(["tanh", "sigmoid", "relu"])] * 2)
)
def test_the_search_bounds_hold_up_to_rounding(seed, kinds):
    random = np.random.default_rng(seed)
    layers = some_layers(random, [3, 6, 5, 1], [*(k.capitalize() for k in kinds), ""])
    mine = [Layer(w, b, k.lower() or "linear") for w, b, k in layers]
    lower = random.normal(size=(4, 3))
    upper = lower + random.uniform(size=(4, 1)) * random.uniform(size=(4, 3))
    found = Lines(mine).bound(lower, upper, np.array([[1.0], [-1.0]]))
    for box in range(4):
        values = computed(layers, random.uniform(lower[box], upper[box], size=(50, 3)))
        assert found.least[box, 0] <= values.min() + 1e-9
        assert -found.least[box, 1] >= values.max() - 1e-9


@pytest.mark.parametrize(
    ("category", "network", "id", "verdict"),
    [
        ("open_loop", f"{NAME}.onnx", f"{NAME}.open_loop.f3m.steer", "unsat"),
        ("open_loop", f"{NAME}.onnx", f"{NAME}.open_loop.f2m.missing1", "sat"),
        ("unrolled", f"unrolled/{NAME}.k1.onnx.gz", f"{NAME}.unrolled.k1.box", "unsat"),
        ("unrolled", f"unrolled/{NAME}.k2.line100mm.p0.onnx.gz",
         f"{NAME}.unrolled.k2.line100mm.p0.cover", "unsat"),
    ],
)  # fmt: skip
def test_published_questions(tmp_path, category, network, id, verdict):
    onnx = REPOSITORY / "onnx" / network
    spec = REPOSITORY / "vnnlib" / category / "2.0" / f"{id}.vnnlib.gz"
    result, certificate = tmp_path / "result.txt", tmp_path / "c.h5"
    arguments = ["query", str(onnx), str(spec), "--json", "--result", str(result)]
    done = CliRunner().invoke(main, [*arguments, "--certificate", str(certificate)])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["verdict"] == verdict
    first, _, rest = result.read_text().partition("\n")
    assert first == verdict
    if verdict == "unsat":
        assert check(certificate, spec, onnx).verdict == "valid"
    else:
        query = read_query(gzip.decompress(spec.read_bytes()).decode(), "q")
        found = judge_witness(query, onnx.read_bytes(), "net", rest.encode())
        assert found.outcome is WitnessOutcome.CORRECT


def test_a_box_within_another_one(tmp_path):
    """Each alternative is asked about in its own box, and the larger one's is harder."""
    text = query_1(1, 1, "(or (and (>= X_0 0) (<= X_0 4) (>= Y_0 4.5))"
                   " (and (>= X_0 1) (<= X_0 2) (>= Y_0 2.5))"
                   " (and (>= X_0 1) (<= X_0 2) (<= Y_0 0.5)))")  # fmt: skip
    onnx, spec = files(tmp_path, linear_network([[1]]), text)
    answer = decide(onnx, spec, 20.0, tmp_path / "c.h5")
    assert answer.verdict == "unsat"
    found = check(tmp_path / "c.h5", spec, onnx)
    assert found.verdict == "valid"
    assert found.margin == pytest.approx(0.5)


def test_what_asks_nothing_of_the_outputs_is_sat(tmp_path):
    onnx, spec = files(tmp_path, linear_network([[1]]), query_1(1, 1, "(>= X_0 0)", "(<= X_0 1)"))
    answer = decide(onnx, spec, 5.0)
    assert answer.verdict == "sat"
    assert judged(onnx, spec, answer.witness).outcome is WitnessOutcome.CORRECT


def test_a_strict_condition_that_is_met_as_an_equality_is_not_sat(tmp_path):
    """The largest output is 1, which > excludes; the checker reads >= and proves nothing."""
    text = query_1(1, 1, "(>= X_0 0)", "(<= X_0 1)", "(> Y_0 1)")
    onnx, spec = files(tmp_path, linear_network([[1]]), text)
    assert decide(onnx, spec, 1.0).verdict == "unknown"

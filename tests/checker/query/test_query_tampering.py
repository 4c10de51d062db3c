"""Certificates of questions: sound ones are accepted, changed ones and false ones are not."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from asking import chain, computed, question, some_layers
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from checker.files import Unreadable
from checker.query.check import check
from verifier.cli import main
from verifier.query.decide import decide


@dataclass(frozen=True)
class Proof:
    """Files of a question that is unsat, and what its certificate holds."""

    onnx: Path
    spec: Path
    certificate: Path
    attributes: dict
    arrays: dict

    def changed(self, folder, attributes=(), **arrays):
        """Return a copy with other arrays (names with _ for /) or attributes, written."""
        path = folder / "changed.h5"
        named = {name.replace("_", "/"): array for name, array in arrays.items()}
        with h5py.File(path, "w") as file:
            file.attrs.update({**self.attributes, **dict(attributes)})
            for name, array in {**self.arrays, **named}.items():
                file[name] = array
        return replace(self, certificate=path)

    def verdict(self, **options):
        return check(self.certificate, self.spec, self.onnx, **options).verdict


def written(folder, layers, text):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "net.onnx").write_bytes(chain(layers))
    (folder / "q.vnnlib").write_text(text)
    return folder / "net.onnx", folder / "q.vnnlib"


def proof_in(folder, layers, text):
    onnx, spec = written(folder, layers, text)
    answer = decide(onnx, spec, 20.0, folder / "c.h5")
    assert answer.verdict == "unsat", answer
    with h5py.File(folder / "c.h5") as file:
        names = "boxes/lower", "boxes/upper", "nodes/dim", "nodes/at"
        return Proof(onnx, spec, folder / "c.h5", dict(file.attrs), {n: file[n][()] for n in names})


LAYERS = some_layers(np.random.default_rng(3), [2, 12, 12, 1], ["Tanh", "Tanh", ""])
BOX = np.array([-1.0, -1.0]), np.array([1.0, 1.0])


def reached(lower, upper):
    """Return the least and the largest output on a grid of a box."""
    grid = np.stack(np.meshgrid(*np.linspace(lower, upper, 200).T), axis=-1).reshape(-1, 2)
    found = computed(LAYERS, grid)
    return float(found.min()), float(found.max())


@pytest.fixture(scope="module")
def proof(tmp_path_factory):
    """A proof of two boxes of which the first takes many leaves."""
    least, most = reached(*BOX)
    room = 0.02 * (most - least)
    text = question(*BOX, f"(or (<= Y_0 {least - room:.6f}) (>= Y_0 {most + room:.6f}))")
    second = "(or (and (<= X_0 0.0)) (and (>= X_0 0.25) (<= X_1 0.5)))"
    return proof_in(tmp_path_factory.mktemp("proof"), LAYERS, text + f"(assert {second})\n")


def test_a_proof_is_accepted_and_its_margin_is_true(proof):
    found = check(proof.certificate, proof.spec, proof.onnx)
    assert found.verdict == "valid"
    assert len(proof.arrays["boxes/lower"]) == 2
    assert found.rows == found.checked == np.count_nonzero(proof.arrays["nodes/dim"] == -1) > 5
    least, most = reached(*BOX)
    assert 0 < found.margin <= 0.02 * (most - least) + 1e-6


def test_a_sample_proves_nothing(proof):
    found = check(proof.certificate, proof.spec, proof.onnx, sample=3, seed=1)
    assert (found.verdict, found.checked) == ("sampled", 3)


def test_a_copy_is_accepted(proof, tmp_path):
    assert proof.changed(tmp_path).verdict() == "valid"


def test_every_missing_leaf_is_noticed(proof, tmp_path):
    dim, at = proof.arrays["nodes/dim"], proof.arrays["nodes/at"]
    for k in np.flatnonzero(dim == -1):
        kept = np.arange(len(dim)) != k
        assert proof.changed(tmp_path, nodes_dim=dim[kept], nodes_at=at[kept]).verdict() == (
            "rejected"
        )


def test_a_division_left_out_is_noticed(proof, tmp_path):
    """Its leaf is as large as all that it was divided into, and is not proved."""
    dim = proof.arrays["nodes/dim"]
    first = int(np.flatnonzero(dim >= 0)[0])
    rest = np.flatnonzero(dim == -1)[1:]
    found = proof.changed(tmp_path, nodes_dim=np.array([-1, -1]), nodes_at=np.zeros(2))
    assert len(rest) > 1
    assert first == 0
    assert found.verdict() == "rejected"


@pytest.mark.parametrize("end", ["boxes_lower", "boxes_upper"])
@pytest.mark.parametrize("box", [0, 1])
@pytest.mark.parametrize("dim", [0, 1])
def test_a_box_that_is_too_small_is_noticed(proof, tmp_path, end, box, dim):
    array = proof.arrays[end.replace("_", "/")].copy()
    inwards = np.inf if end == "boxes_lower" else -np.inf
    array[box, dim] = np.nextafter(array[box, dim], inwards)
    assert proof.changed(tmp_path, **{end: array}).verdict() == "rejected"


def test_a_box_left_out_is_noticed(proof, tmp_path):
    lower, upper = proof.arrays["boxes/lower"][:1], proof.arrays["boxes/upper"][:1]
    assert proof.changed(tmp_path, boxes_lower=lower, boxes_upper=upper).verdict() == "rejected"


def test_a_cut_outside_of_its_box_is_noticed(proof, tmp_path):
    at = proof.arrays["nodes/at"].copy()
    at[np.flatnonzero(proof.arrays["nodes/dim"] >= 0)[0]] = 7.0
    assert proof.changed(tmp_path, nodes_at=at).verdict() == "rejected"


def test_a_cut_of_no_input_is_noticed(proof, tmp_path):
    for wrong in (2, -2):
        dim = proof.arrays["nodes/dim"].copy()
        dim[np.flatnonzero(dim >= 0)[0]] = wrong
        assert proof.changed(tmp_path, nodes_dim=dim).verdict() == "rejected"


def test_another_network_or_question_is_noticed(proof, tmp_path):
    other = some_layers(np.random.default_rng(4), [2, 12, 12, 1], ["Tanh", "Tanh", ""])
    onnx, _ = written(tmp_path, other, "")
    assert replace(proof, onnx=onnx).verdict() == "rejected"
    spec = tmp_path / "other.vnnlib"
    spec.write_text(proof.spec.read_text().replace("(<= X_0 0.0)", "(<= X_0 0.1)"))
    assert replace(proof, spec=spec).verdict() == "rejected"
    # Nor does it help to name it: the boxes are not those of the question.
    named = {"spec_sha256": hashlib.sha256(spec.read_bytes()).hexdigest()}
    assert replace(proof.changed(tmp_path, named), spec=spec).verdict() == "rejected"


def test_a_network_that_is_named_but_does_otherwise_is_noticed(proof, tmp_path):
    moved = [*LAYERS[:-1], (LAYERS[-1][0], LAYERS[-1][1] + np.float32(5), "")]
    onnx, _ = written(tmp_path, moved, "")
    named = {"onnx_sha256": hashlib.sha256(onnx.read_bytes()).hexdigest()}
    assert replace(proof.changed(tmp_path, named), onnx=onnx).verdict() == "rejected"


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32), depth=st.integers(0, 6), share=st.floats(0, 1))
def test_no_division_proves_what_is_false(tmp_path_factory, seed, depth, share):
    """The threshold is reached: whatever tree is given, the checker does not accept it."""
    random = np.random.default_rng(seed)
    layers = some_layers(random, [2, 6, 1], ["Tanh", ""])
    point = random.uniform(*BOX)
    value = float(computed(layers, point[None])[0, 0])
    folder = tmp_path_factory.mktemp("false")
    onnx, spec = written(folder, layers, question(*BOX, f"(<= Y_0 {value + 1e-9:.12f})"))
    dims, ats = [], []

    def grow(low, high, left):
        if left == 0:
            dims.append(-1)
            ats.append(0.0)
            return
        dim = int(random.integers(0, 2))
        at = low[dim] + share * (high[dim] - low[dim])
        dims.append(dim)
        ats.append(at)
        first, second = high.copy(), low.copy()
        first[dim] = second[dim] = at
        grow(low, first, left - 1)
        grow(second, high, left - 1)

    grow(*BOX, depth)
    path = folder / "c.h5"
    with h5py.File(path, "w") as file:
        file.attrs["format"], file.attrs["version"] = "closedlap-query-certificate", "1.0"
        file.attrs["onnx_sha256"] = hashlib.sha256(onnx.read_bytes()).hexdigest()
        file.attrs["spec_sha256"] = hashlib.sha256(spec.read_bytes()).hexdigest()
        file["boxes/lower"], file["boxes/upper"] = BOX[0][None], BOX[1][None]
        file["nodes/dim"], file["nodes/at"] = np.array(dims), np.array(ats)
    assert check(path, spec, onnx).verdict == "rejected"


def test_files_that_are_none_are_refused(proof, tmp_path):
    broken = tmp_path / "broken.h5"
    broken.write_bytes(proof.certificate.read_bytes()[:100])
    with pytest.raises(Unreadable):
        check(broken, proof.spec, proof.onnx)
    at = proof.arrays["nodes/at"].copy()
    at[0] = np.nan
    with pytest.raises(Unreadable):
        proof.changed(tmp_path, nodes_at=at).verdict()
    with pytest.raises(Unreadable):
        proof.changed(tmp_path, {"format": "closedlap-certificate"}).verdict()


def test_the_command_checks_and_says_what_is_wrong(proof, tmp_path):
    arguments = ["check", str(proof.certificate), str(proof.spec), "--network", str(proof.onnx)]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    assert done.output.startswith("valid: proved margin at least ")
    tampered = proof.changed(tmp_path, nodes_at=proof.arrays["nodes/at"] + 9)
    arguments[1] = str(tampered.certificate)
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 1
    assert done.output.startswith("rejected: node ")

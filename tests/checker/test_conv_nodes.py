"""Convolutional controllers: verified, and read by the checker on its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from certified import ONNX, QUICK, proved

from checker.files import Unreadable, read_instance
from generator.seeds import file_sha256
from racecar.controller import Controller, load_controller, save_controller
from racecar.layers import Convolution, Layer


def convolutional() -> Controller:
    """Return a published controller behind a convolution that takes every ray as it is.

    Two channels, each reading one ray in a window; the second channel is ignored.
    """
    published = load_controller(ONNX / "TD3_L21_64x64_C1.onnx")
    kernels = np.array([[[1.0]], [[0.5]]], np.float32)
    shifted = Convolution(kernels, np.array([0.0, 0.25], np.float32), 1, 21).layer("linear")
    first, *others = published.layers
    wider = np.concatenate([first.weights, np.zeros_like(first.weights)], axis=1)
    return Controller((shifted, Layer(wider, first.biases, first.activation), *others))


def written(folder: Path, controller: Controller) -> Path:
    """Write an instance of five steps that the controller drives."""
    save_controller(controller, folder / "conv.onnx")
    data = json.loads((QUICK / "TD3_L21_64x64_C1.quick.straight05.clearance.json").read_text())
    sha256 = file_sha256(folder / "conv.onnx")
    data["controller"] = {"name": "conv", "file": "conv.onnx", "sha256": sha256}
    (folder / "i.json").write_text(json.dumps(data))
    return folder / "i.json"


def test_a_proof_for_conv_nodes_is_checked(tmp_path):
    proof = proved(written(tmp_path, convolutional()), tmp_path, "c")
    assert proof.fault(proof.certificate) == ""
    too_much = replace(proof.certificate, margin=proof.certificate.margin + 0.05)
    assert proof.fault(too_much)


@pytest.mark.parametrize("seed", range(3))
def test_the_checker_reads_the_same_layers(tmp_path, seed):
    random = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return random.normal(size=shape).astype(np.float32)

    one = Convolution(normal(3, 1, 5), normal(3), 2, 21)
    two = Convolution(normal(2, 3, 4), normal(2), 3, one.places)
    gemm = Layer(normal(1, 2 * two.places), normal(1), "tanh")
    controller = Controller((one.layer("relu"), two.layer("tanh"), gemm))
    read = read_instance(written(tmp_path, controller)).layers
    for ours, its in zip(controller.layers, read, strict=True):
        assert np.array_equal(ours.weights, its.weights)
        assert np.array_equal(ours.biases, its.biases)
        assert ours.activation == its.activation.lower()


def test_the_checker_refuses_padding(tmp_path):
    path = written(tmp_path, convolutional())
    model = onnx.load(tmp_path / "conv.onnx")
    for attribute in model.graph.node[1].attribute:
        if attribute.name == "pads":
            attribute.ints[:] = [0, 1, 0, 0]
    onnx.save(model, tmp_path / "conv.onnx")
    data = json.loads(path.read_text())
    data["controller"]["sha256"] = file_sha256(tmp_path / "conv.onnx")
    path.write_text(json.dumps(data))
    with pytest.raises(Unreadable, match="not a plain convolution"):
        read_instance(path)

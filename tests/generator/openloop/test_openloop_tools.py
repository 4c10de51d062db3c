"""Verifiers from PyPI read the files, and answer what must be answered.

Each lives in its own virtual environment (tools_venv). Marabou is tried on small networks: on
those of the paper's size its answers for tanh are not to be trusted (docs/vnnlib.md).
"""

import math
from fractions import Fraction

import numpy as np
import pytest
from tools_venv import marabou, vibecheck

from generator.instances import benchmark_plant
from generator.openloop.printer import print_spec
from generator.openloop.questions import open_loop_questions
from generator.openloop.spec import Box, OutputBound, Spec
from racecar.controller import Controller, Layer, save_controller

LOW, HIGH = OutputBound(0, "<=", np.float32(-2)), OutputBound(0, ">=", np.float32(0.9))


def bump():
    """tanh(8 (x - 1)) - tanh(8 (x - 2)) - 1 is near 1 for x between 1 and 2, near -1 elsewhere."""
    first = Layer(np.float32([[8], [8]]), np.float32([-8, -16]), "tanh")
    return Controller((first, Layer(np.float32([[1, -1]]), np.float32([-1]), "linear")))


def box(low, high):
    return Box.inside([Fraction(low)], [Fraction(high)])


#: Boxes, unsafe outputs, the answer: also where only what lies between two boxes is unsafe.
CASES = {
    "one box around the bump": ([box(0, 3)], ((HIGH,),), "sat"),
    "beside the bump": ([box("0.5", "0.75")], ((HIGH,),), "unsat"),
    "either of two outputs": ([box(0, 3)], ((LOW,), (HIGH,)), "sat"),
    "neither of two outputs": ([box(0, "0.5")], ((LOW,), (HIGH,)), "unsat"),
    "two boxes, one output": ([box(0, "0.5"), box("1.25", "1.75")], ((HIGH,),), "sat"),
    "the bump lies between the boxes": ([box(0, "0.5"), box("2.5", 3)], ((HIGH,),), "unsat"),
    "between, two outputs": ([box(0, "0.5"), box("2.5", 3)], ((LOW,), (HIGH,)), "unsat"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, make_controller):
    """Networks, and the questions about the small one in both versions."""
    folder = tmp_path_factory.mktemp("tools")
    small = make_controller(5)
    save_controller(bump(), folder / "bump.onnx")
    save_controller(small, folder / "small.onnx")
    for question in open_loop_questions("A", small, benchmark_plant(5, math.radians(230))):
        for version in ("1.0", "2.0"):
            text = print_spec(question.spec, version)
            (folder / f"{question.id}.{version}.vnnlib").write_text(text)
    return folder


def write(folder, name, version):
    boxes, unsafe, answer = CASES[name]
    path = folder / f"case.{version}.vnnlib"
    path.write_text(print_spec(Spec((name,), tuple(boxes), 1, unsafe), version))
    return path, answer


@pytest.mark.parametrize("name", CASES)
def test_marabou_answers_every_shape_of_specification(folder, name):
    path, answer = write(folder, name, "1.0")
    assert marabou(folder / "bump.onnx", path, folder) == answer


@pytest.mark.parametrize("label", ["f6m.noise10mm", "f4m.steer", "f3m.range5", "f3m.missing1"])
def test_marabou_proves_questions_about_a_small_controller(folder, label):
    # It steers by less than half a degree, which is what every interval allows at least.
    path = folder / f"A.open_loop.{label}.1.0.vnnlib"
    assert marabou(folder / "small.onnx", path, folder) == "unsat"


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("name", CASES)
def test_vibecheck_answers_every_shape_of_specification(folder, name, version):
    path, answer = write(folder, name, version)
    assert vibecheck(folder / "bump.onnx", path, folder) == answer


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("label", ["f6m.noise100mm", "f3m.missing1", "f3m.missing2adjacent"])
def test_vibecheck_proves_questions_about_a_small_controller(folder, label, version):
    path = folder / f"A.open_loop.{label}.{version}.vnnlib"
    assert vibecheck(folder / "small.onnx", path, folder) == "unsat"

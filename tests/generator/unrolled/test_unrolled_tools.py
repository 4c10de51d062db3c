"""vibecheck (PyPI) reads the graphs of wall patterns and proves short runs safe."""

import math
from pathlib import Path

import pytest
from tools_venv import vibecheck

from generator.instances import ControllerFile, benchmark_plant
from generator.openloop.printer import print_spec
from generator.unrolled.questions import unrolled_questions

FILE = Path(__file__).parents[3] / "onnx" / "TD3_L21_64x64_C1.onnx"


@pytest.fixture(scope="module")
def short():
    """The questions about one and two steps, as text, with their graphs."""
    controller = ControllerFile.load(FILE).controller
    made = unrolled_questions("A", controller, benchmark_plant(21, math.radians(230)))
    found = {}
    for _, (graphs, questions) in zip(range(2), made, strict=False):
        contents = {graph.name: graph.content for graph in graphs}
        found |= {q.id.removeprefix("A.unrolled."): (contents[q.graph], q.spec) for q in questions}
    return found


@pytest.mark.parametrize(("steps", "kind", "version"), [
    (1, "safe", "1.0"), (1, "cover", "2.0"), (2, "safe", "2.0"), (2, "cover", "1.0"),
])  # fmt: skip
def test_vibecheck_proves_pattern_instances(short, tmp_path, steps, kind, version):
    names = [n for n in short if n.startswith(f"k{steps}.line") and n.endswith(f"p0.{kind}")]
    if not names:
        pytest.skip("this controller has no line of safe starts near the turn")
    content, spec = short[names[0]]
    (tmp_path / "net.onnx").write_bytes(content)
    (tmp_path / "spec.vnnlib").write_text(print_spec(spec, version))
    verdict = vibecheck(tmp_path / "net.onnx", tmp_path / "spec.vnnlib", tmp_path)
    # Two steps of a controller that steers wildly may be too much; a witness there is not.
    assert verdict == "unsat" or (steps == 2 and verdict in {"unknown", "timeout"})

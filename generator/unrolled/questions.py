"""The questions about the unrolled closed loop: graphs and specifications."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import onnx

from generator.openloop.spec import Conjunction, OutputBound, Spec
from generator.openloop.views import MIDDLE
from generator.unrolled.general import general_graph
from generator.unrolled.geometry import StartBox
from generator.unrolled.graph import Task
from generator.unrolled.patterns import Pattern
from generator.unrolled.smooth import pattern_graph
from generator.unrolled.starts import LONG, SHORT, Drive, StartSet, pattern_set, start_sets
from racecar.closed_loop import Plant
from racecar.controller import Controller, weights_sha256
from racecar.safety import named_property

STEPS = (*SHORT, LONG)
#: How many times as long as for one step a tool may take, by the number of steps.
PATIENCE = {1: 1, 2: 1, 5: 2, 10: 2, 20: 5, 70: 10}
_SAFETY = "clearance"


@dataclass(frozen=True)
class Graph:
    """An unrolled network: the name of its file without the ending, and its bytes."""

    name: str
    content: bytes


@dataclass(frozen=True)
class UnrolledQuestion:
    """One specification of an unrolled network; graph: its name; patience: see PATIENCE."""

    id: str
    graph: str
    spec: Spec
    patience: int


def unrolled_questions(
    name: str, controller: Controller, plant: Plant, start: Fraction = MIDDLE, tag: str = ""
) -> Iterator[tuple[list[Graph], list[UnrolledQuestion]]]:
    """Yield graphs and the questions about them for each number of steps.

    start: of the nominal drive (s, m); tag: begins what follows the controller in names.
    """
    safety = named_property(_SAFETY, plant.track)
    drive = Drive(controller, plant, safety, start)
    for steps in STEPS:
        sets = list(start_sets(drive, steps))
        line = pattern_set(drive, steps)
        everywhere = [*sets, *([line[0]] if line else [])]
        if not everywhere:
            continue
        hull = StartBox(
            np.min([chosen.bounds.lower for chosen in everywhere], axis=0),
            np.max([chosen.bounds.upper for chosen in everywhere], axis=0),
        )
        about = _About(name, tag, Task(controller, plant, safety, hull, steps))
        graphs = [about.general()]
        questions = [about.safe(chosen, graphs[0]) for chosen in everywhere]
        if line:
            for number in range(len(line[1])):
                graph, both = about.pattern(*line, number)
                graphs.append(graph)
                questions += both
        yield graphs, questions


@dataclass(frozen=True)
class _About:
    """A controller's name, the tag of its names, and what is unrolled of it."""

    name: str
    tag: str
    task: Task

    @property
    def steps(self) -> int:
        return self.task.steps

    def general(self) -> Graph:
        """Return the general graph."""
        metadata = self._metadata("general")
        return self._graph(f"k{self.steps}", general_graph(self.task, metadata=metadata))

    def safe(self, starts: StartSet, graph: Graph) -> UnrolledQuestion:
        """Ask whether a margin can be at most 0."""
        unsafe = tuple((_at_most_0(i),) for i in range(self.steps))
        words = "unsafe: after some step the margin is at most 0"
        return self._question(starts, starts.label, graph, self.steps, unsafe, words)

    def pattern(
        self, starts: StartSet, patterns: list[Pattern], number: int
    ) -> tuple[Graph, list[UnrolledQuestion]]:
        """Return the graph of one pattern, and whether it is safe and whether the list is whole."""
        task = Task(
            self.task.controller, self.task.plant, self.task.safety, starts.bounds, self.steps
        )
        pattern, k = patterns[number], self.steps
        listed = " ".join(f"{view.side.name.lower()}:{view.split}" for view in pattern)
        metadata = self._metadata("pattern") | {"pattern": listed}
        label = f"{starts.label}.p{number}"
        graph = self._graph(
            f"k{k}.{label}", pattern_graph(task, patterns, pattern, metadata=metadata)
        )
        safe = tuple((_at_least_0(k + i), _at_most_0(i)) for i in range(k))
        leaves: list[Conjunction] = [(_at_most_0(2 * k),)]
        leaves += [(_at_least_0(k + i - 1), _at_most_0(2 * k + i)) for i in range(1, k)]
        of = f"wall pattern {number + 1} of {len(patterns)}"
        return graph, [
            self._question(
                starts, f"{label}.safe", graph, 3 * k, safe,
                f"unsafe: {of} holds, and after some step the margin is at most 0",
            ),
            self._question(
                starts, f"{label}.cover", graph, 3 * k, tuple(leaves),
                f"unsafe: {of} holds up to an instant at which no listed pattern goes on",
            ),
        ]  # fmt: skip

    def _question(
        self,
        starts: StartSet,
        label: str,
        graph: Graph,
        outputs: int,
        unsafe: tuple[Conjunction, ...],
        words: str,
    ) -> UnrolledQuestion:
        plural = "step" if self.steps == 1 else "steps"
        title = (
            f"{self.name}, {self.steps} {plural} of the closed loop, property {_SAFETY}",
            f"starts (s, f, v, theta): {starts.words}",
            words,
        )
        spec = Spec(title, (starts.box,), outputs, unsafe)
        id = f"{self.name}.unrolled.{self.tag}k{self.steps}.{label}"
        return UnrolledQuestion(id, graph.name, spec, PATIENCE[self.steps])

    def _graph(self, label: str, model: onnx.ModelProto) -> Graph:
        return Graph(f"{self.name}.{self.tag}{label}", model.SerializeToString(deterministic=True))

    def _metadata(self, kind: str) -> dict[str, str]:
        return {
            "controller": self.name,
            "weights_sha256": weights_sha256(self.task.controller),
            "steps": str(self.steps),
            "property": _SAFETY,
            "kind": kind,
            "input": "s (m), f (m), v (m/s), theta (rad), in the frame of the first hall",
        }


def _at_most_0(index: int) -> OutputBound:
    return OutputBound(index, "<=", np.float32(0))


def _at_least_0(index: int) -> OutputBound:
    return OutputBound(index, ">=", np.float32(0))

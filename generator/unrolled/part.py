"""What the category of unrolled networks adds to the emitted tree, for one controller."""

from __future__ import annotations

from generator.instances import ControllerFile
from generator.openloop.part import NETWORKS, Asked, Draw, Part
from generator.unrolled.questions import unrolled_questions
from racecar.closed_loop import Plant

#: Every graph holds the weights anew: a controller's take up to 1.5 MB, gzipped.
MOST_WEIGHTS = 20_000


def unrolled_part(
    file: ControllerFile, plant: Plant, category: str, timeout: int, draw: Draw
) -> Part:
    """Return the unrolled networks of a controller and the questions about them.

    timeout: for one step; longer runs get more. Nothing for large controllers, those of more rays
    than the paper's, and further seeds of a setup.
    """
    part = Part()
    if not file.small or file.weights > MOST_WEIGHTS or file.further_seed:
        return part
    asked_for = unrolled_questions(file.name, file.controller, plant, draw.start, draw.tag)
    for graphs, questions in asked_for:
        for graph in graphs:
            part.files[network_path(category, graph.name)] = graph.content
        for question in questions:
            network = network_path(category, question.graph)
            asked = Asked(question.id, network, question.patience * timeout)
            part.add(category, asked, question.spec)
    return part


def network_path(category: str, name: str) -> str:
    """Return where an unrolled network lies below the root."""
    return f"{NETWORKS}/{category}/{name}.onnx"

"""Tiny instances whose answers follow from a line of arithmetic, to try a tool on.

The answers are stated here with their reasons; no verifier was asked.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.catalogue import Entry
from harness.description import Format
from harness.records import Verdict
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.controller import Controller, Layer, save_controller, write_whole
from racecar.instance import (
    ControllerReference,
    InitialSet,
    Instance,
    plant_data,
    property_data,
    save_instance,
)
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import square_track

#: A box per input: lower and upper bound.
Bounds = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Tiny:
    """An instance with its answer, and why that is the answer."""

    entry: Entry
    format: Format
    answer: Verdict
    reason: str


@dataclass(frozen=True)
class _Query:
    """A question about a network: some x in one of the boxes with y >= least."""

    name: str
    network: str
    boxes: Sequence[Bounds]
    least: float
    answer: Verdict
    reason: str


_UNIT = ((0.0, 1.0), (0.0, 1.0))
_QUERIES = (
    _Query(
        "difference_small", "difference", [_UNIT], 1.5, Verdict.UNSAT,
        "y = x0 - x1 is at most 1 on the unit square, and 1.5 is asked for",
    ),
    _Query(
        "difference_large", "difference", [_UNIT], 0.5, Verdict.SAT,
        "y = x0 - x1 is 1 at (1, 0), and 0.5 is asked for",
    ),
    _Query(
        "bump", "bump", [[(0.0, 3.0)]], 0.75, Verdict.SAT,
        "y = tanh(8 (x - 1)) - tanh(8 (x - 2)) - 1 is 0.998 at 1.5, and 0.75 is asked for",
    ),
    _Query(
        "beside_bump", "bump", [[(0.5, 0.75)]], 0.75, Verdict.UNSAT,
        "y is at most tanh(-2) + 1 - 1 < -0.9 there, and 0.75 is asked for",
    ),
    _Query(
        "between_boxes", "bump", [[(0.0, 0.5)], [(2.5, 3.0)]], 0.75, Verdict.UNSAT,
        "y is below -0.9 in both boxes; only between them it is large",
    ),
)  # fmt: skip


def make_tiny(folder: Path, formats: Sequence[Format], timeout: float) -> list[Tiny]:
    """Write the instances in the given formats below a folder; times in seconds."""
    wanted = dict.fromkeys(format_.given for format_ in formats)
    made: list[Tiny] = []
    for format_ in wanted:
        make = _closed_loops if format_ is Format.JSON else _queries
        made += make(folder, format_, timeout)
    return made


def _networks() -> dict[str, Controller]:
    subtract = [[1.0, -1.0]]
    bump = (_layer([[8.0], [8.0]], [-8.0, -16.0], "tanh"), _layer(subtract, [-1.0], "linear"))
    difference = (_layer(subtract, [0.0], "linear"),)
    return {"bump": Controller(bump), "difference": Controller(difference)}


def _layer(weights: list[list[float]], bias: list[float], activation: str) -> Layer:
    return Layer(np.array(weights, np.float32), np.array(bias, np.float32), activation)


def _queries(folder: Path, format_: Format, timeout: float) -> Iterator[Tiny]:
    version = format_.removeprefix("vnnlib-")
    for name, network in _networks().items():
        save_controller(network, folder / "onnx" / f"{name}.onnx")
    for query in _QUERIES:
        spec = folder / "vnnlib" / "tiny" / version / f"{query.name}.vnnlib"
        write_whole(spec, _vnnlib(query, version).encode())
        onnx = folder / "onnx" / f"{query.network}.onnx"
        entry = Entry(query.name, "tiny", onnx, spec, timeout)
        yield Tiny(entry, format_, query.answer, query.reason)


def _vnnlib(query: _Query, version: str) -> str:
    count = len(query.boxes[0])
    x, y = ("X_{}", "Y_0") if version == "1.0" else ("X[0,{}]", "Y[0,0]")
    if version == "1.0":
        head = [f"(declare-const X_{i} Real)" for i in range(count)]
        head.append("(declare-const Y_0 Real)")
    else:
        head = ["(vnnlib-version <2.0>)", "(declare-network N"]
        head += [f"  (declare-input X float32 [1,{count}])", "  (declare-output Y float32 [1,1])"]
        head.append(")")
    least = f"(>= {y} {query.least})"
    boxes = [
        " ".join(
            f"(>= {x.format(i)} {low}) (<= {x.format(i)} {high})"
            for i, (low, high) in enumerate(box)
        )
        for box in query.boxes
    ]
    if len(boxes) == 1:
        bounds = boxes[0].replace(") (", ")\n(").split("\n")
        asserted = [f"(assert {bound})" for bound in [*bounds, least]]
    else:
        cases = "\n".join(f"  (and {box} {least})" for box in boxes)
        asserted = [f"(assert (or\n{cases}\n))"]
    return "\n".join([f"; {query.reason}", *head, *asserted]) + "\n"


def _closed_loops(folder: Path, format_: Format, timeout: float) -> Iterator[Tiny]:
    """A car that always drives straight ahead; at rest, 9.9 m before the wall, unless said."""
    plant = Plant(square_track(), Bicycle(), Lidar())
    onnx = folder / "onnx" / "straight.onnx"
    rays = plant.lidar.rays
    # tanh, then a factor: what the languages of hybrid systems can say of a controller.
    layers = (_layer([[0.0] * rays], [0.0], "tanh"), _layer([[0.25]], [0.0], "linear"))
    save_controller(Controller(layers), onnx)
    for name, s, steps, answer, reason in (
        ("straight_short", (0.7, 0.8), 5, Verdict.UNSAT,
         "it starts at rest in the middle of the hall and gains less than 4 m/s2 for 0.5 s"),
        ("straight_long", (0.7, 0.8), 70, Verdict.SAT,
         "in 7 s it drives more than 15 m, and the wall ahead is at 9.9 m"),
        ("start_unsafe", (0.25, 0.5), 5, Verdict.SAT,
         "a start at s = 0.25 is closer than 0.3 m to the left wall at once"),
    ):  # fmt: skip
        spec = folder / "json" / "tiny" / f"{name}.json"
        instance = Instance(
            id=name,
            category="tiny",
            controller=ControllerReference(
                name="straight",
                file="../../onnx/straight.onnx",
                sha256=hashlib.sha256(onnx.read_bytes()).hexdigest(),
            ),
            plant=plant_data(plant),
            initial_set=InitialSet(s=s, f=(9.9, 9.9), v=(0.0, 0.0), theta=(0.0, 0.0)),
            steps=steps,
            property=property_data(named_property("clearance", plant.track)),
        )
        save_instance(instance, spec)
        yield Tiny(Entry(name, "tiny", onnx, spec, timeout), format_, answer, reason)

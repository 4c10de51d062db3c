"""Which instances get a picture, and making those whose ingredients changed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from harness.given import Malformed, given_steps
from harness.records import WitnessOutcome
from harness.replay import parse_witness
from leaderboard.board import Board, Result
from leaderboard.questions import Question
from leaderboard.scene import scene, script
from leaderboard.traces import (
    DISTURBED,
    Trace,
    cut,
    drive,
    fits,
    given_faults,
    sample_faults,
    sample_starts,
    witness_starts,
)
from leaderboard.tube import Tube, read_tube, sha256_of
from racecar.closed_loop import Plant, Steer
from racecar.controller import RuntimeSteer, runtime_session
from racecar.errors import BadInput
from racecar.instance import InitialSet, parse_instance
from racecar.polygon import Array
from racecar.safety import Property
from racecar.witness import Witness

Some = TypeVar("Some")

#: So many numbers of noise are in memory at a time.
_NUMBERS = 20_000_000
_MAKERS = ("pictures.py", "scene.py", "traces.py", "tube.py")


def _makers() -> str:
    """Return a hash of the code that makes pictures: where it changes, all are made anew."""
    sources = [(Path(__file__).parent / name).read_bytes() for name in _MAKERS]
    return hashlib.sha256(b"".join(sources)).hexdigest()


@dataclass(frozen=True)
class Order:
    """One picture to make. key: names all that it is made of."""

    question: Question
    witness: tuple[str, bytes] | None
    certificate: Path | None
    key: str


def orders(
    board: Board,
    read_witness: Callable[[Result], bytes],
    certificates: Mapping[str, Path],
) -> Iterator[Order]:
    """Yield an order for every closed-loop instance whose files are those that were run."""
    makers = _makers()
    for question in board.instances:
        if question.data is None or question.spec is None or question.onnx is None:
            continue
        witness = _best_witness(board.results(question.id), read_witness)
        certificate = certificates.get(question.id)
        parts = [
            makers,
            question.spec_sha256,
            question.onnx_sha256,
            *((witness[0], hashlib.sha256(witness[1]).hexdigest()) if witness else ("", "")),
            sha256_of(certificate),
        ]
        key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
        yield Order(question, witness, certificate, key)


def _best_witness(
    results: Sequence[Result], read: Callable[[Result], bytes]
) -> tuple[str, bytes] | None:
    """Return the first tool whose witness holds, with it: strictly, else with tolerance."""
    for wanted in (WitnessOutcome.CORRECT, WitnessOutcome.CORRECT_WITH_TOLERANCE):
        for result in results:
            if result.check is not None and result.check.outcome is wanted:
                return result.record.tool, read(result)
    return None


def draw(todo: Iterable[Order], note: Callable[[str], None]) -> Iterator[tuple[Order, bytes]]:
    """Make pictures; note is told of files that cannot be used. Orders may come back reordered."""
    groups: dict[tuple[str, ...], list[Order]] = {}
    for order in todo:
        data = order.question.data
        assert data is not None
        alike = (data["plant"], data["property"], data["steps"], data.get("disturbance"))
        key = (order.question.onnx_sha256, json.dumps(alike, sort_keys=True))
        groups.setdefault(key, []).append(order)
    for group in groups.values():
        try:
            yield from _Group(group, note).draw()
        except (BadInput, ValidationError) as error:
            reason = " ".join(str(error).split())
            note(f"{group[0].question.id} and {len(group) - 1} more: no picture ({reason})")


class _Group:
    """Pictures of instances that differ only in their start sets."""

    def __init__(self, orders: Sequence[Order], note: Callable[[str], None]) -> None:
        self.orders, self.note = orders, note
        question = orders[0].question
        assert question.spec is not None
        assert question.onnx is not None
        # The instances of a group share all that is slow to check: one stands for all.
        self.instance = parse_instance(question.spec.read_bytes(), str(question.spec))
        self.onnx = question.onnx
        self.plant: Plant = self.instance.make_plant()
        self.safety: Property = self.instance.make_property()
        given = self.instance.disturbance
        self._mirrors = given.mirrors.segments if given is not None and given.mirrors else ()
        self.boxes = [InitialSet.model_validate(_data(order)["initial_set"]) for order in orders]

    def draw(self) -> Iterator[tuple[Order, bytes]]:
        """Yield every picture with its order."""
        traces = self._samples()
        witnesses = self._witnesses()
        for i, order in enumerate(self.orders):
            run, given = witnesses.get(i), order.witness
            witness = (given[0], run) if given is not None and run is not None else None
            picture = scene(
                self.plant, self.safety, traces[i], witness, self._tube(order), self._mirrors
            )
            yield order, script("scene", order.key, picture)

    def _samples(self) -> list[list[Trace]]:
        """Return sampled runs of every instance."""
        steer, steps = RuntimeSteer(self.onnx), self.instance.steps
        disturbance = self.instance.disturbance
        if disturbance is None:
            starts = [sample_starts(box) for box in self.boxes]
            traces = drive(self.plant, steer, self.safety, np.concatenate(starts), steps)
            ends = np.cumsum([len(part) for part in starts])
            return [traces[end - len(part) : end] for part, end in zip(starts, ends, strict=True)]
        samples: list[list[Trace]] = []
        for some in self._portions(list(zip(self.orders, self.boxes, strict=True)), DISTURBED):
            names = [order.question.id for order, _ in some]
            middles = [np.mean(box.bounds(), axis=0) for _, box in some]
            faults = sample_faults(disturbance, self.plant, steps, names)
            cars = np.repeat(middles, DISTURBED, axis=0)
            traces = drive(self.plant, steer, self.safety, cars, steps, faults)
            samples += [traces[i : i + DISTURBED] for i in range(0, len(traces), DISTURBED)]
        return samples

    def _witnesses(self) -> dict[int, Trace]:
        """Return the runs of the witnesses, by the place of their orders."""
        given: dict[int, Witness] = {}
        for i, order in enumerate(self.orders):
            if order.witness is not None:
                try:
                    witness = parse_witness(order.witness[1])
                except Malformed:
                    continue
                if fits(self.instance, witness):
                    given[i] = witness
        steer, steps, traces = _judge(self.onnx), self.instance.steps, []
        for some in self._portions(list(given.values()), 1):
            faults = given_faults(self.instance, some)
            runs = drive(self.plant, steer, self.safety, witness_starts(some), steps, faults)
            traces += [
                cut(run, given_steps(self.instance, witness))
                for run, witness in zip(runs, some, strict=True)
            ]
        return dict(zip(given, traces, strict=True))

    def _portions(self, items: Sequence[Some], cars: int) -> Iterator[Sequence[Some]]:
        """Yield so many items at a time that the noise of their cars fits into memory."""
        together = max(1, _NUMBERS // (cars * self.instance.steps * self.plant.lidar.rays))
        for first in range(0, len(items), together):
            yield items[first : first + together]

    def _tube(self, order: Order) -> Tube | None:
        if order.certificate is None:
            return None
        try:
            return read_tube(
                order.certificate, _data(order), order.question.onnx_sha256, self.plant.track
            )
        except BadInput as error:
            self.note(f"{order.question.id}: no reach tube ({error})")
            return None


def _data(order: Order) -> Mapping[str, Any]:
    assert order.question.data is not None
    return order.question.data


def _judge(onnx: Path) -> Steer:
    """Return the controller as the replay of witnesses runs it: float32, one scan at a time."""
    session = runtime_session(onnx)
    name = session.get_inputs()[0].name

    def steer(scan: Array) -> Array:
        rows = np.ascontiguousarray(scan.T, dtype=np.float32)
        return np.array([float(session.run(None, {name: row[None]})[0][0, 0]) for row in rows])

    return steer

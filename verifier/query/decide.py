"""Deciding a VNN-LIB question: look for a witness, then divide the boxes until none can be."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from checker.files import Rejected, Unreadable
from checker.query.check import answered, excluded
from checker.query.files import Asked, read_asked
from harness.query.evaluate import evaluate
from harness.query.network import read_unpacked
from harness.query.read import read_query
from harness.query.terms import Query
from racecar.controller import Controller, parse_controller
from racecar.errors import BadInput
from verifier.query.attack import Witness, best_witness, climb, close_in
from verifier.query.certificate import Hashes, write_certificate
from verifier.query.divide import BATCH, Bound, Found, OutOfTime, Tree, divide
from verifier.query.lines import Lines
from verifier.query.network import Runner
from verifier.query.question import Area, areas
from verifier.query.witness import write_witness

Array = NDArray[np.float64]
#: Share of the time in which a witness is looked for before anything is divided.
_LOOKING = 0.3


@dataclass(frozen=True)
class Answer:
    """A verdict: unsat, sat or unknown, and what stands behind it.

    margin_lower: by so much every alternative misses one of its conditions (unsat), in the
    outputs' unit, as proved by the checker; margin_upper: minus the amount by which the witness
    meets them (sat), or the nearest inputs met; leaves: boxes at the end; witness: the text of
    the result file.
    """

    verdict: str
    margin_lower: float | None
    margin_upper: float | None
    leaves: int
    time_s: float
    note: str = ""
    witness: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as plain data, without the witness, which has a file of its own."""
        return {k: v for k, v in vars(self).items() if k != "witness"}


class _Found(Exception):
    def __init__(self, witness: Witness) -> None:
        super().__init__()
        self.witness = witness


def decide(
    onnx: Path, spec: Path, timeout: float, certificate: Path | None = None, seed: int = 0
) -> Answer:
    """Decide a question; timeout in seconds. Raises BadInput for files that cannot be used.

    certificate: where the proof is written if the answer is unsat, for the checker.
    """
    began = time.monotonic()
    model, text = read_unpacked(onnx), read_unpacked(spec)
    query = read_query(text.decode("utf-8", "replace"), str(spec))
    asked_areas = areas(query)
    runner = Runner(model, str(onnx))
    controller = _controller(model, onnx)

    def answer(verdict: str, **more: Any) -> Answer:
        given = {"margin_lower": None, "margin_upper": None, "leaves": 0} | more
        return Answer(verdict, time_s=round(time.monotonic() - began, 3), **given)

    search = began + _LOOKING * timeout
    if controller is not None:
        found = climb(controller.layers, runner, asked_areas, search, seed)
    else:
        found = close_in(runner, asked_areas, search, seed)
    if found is not None and _holds(found, query, runner):
        return _sat(answer, found, query, runner)
    try:
        asked = read_asked(spec, onnx)
        cases = answered(asked, *_ends(asked_areas, asked.question.inputs))
    except (Unreadable, Rejected) as error:
        return answer("unknown", note=f"the checker does not know such a question: {error}")
    margins: list[float] = []
    trees: list[Tree] = []

    def look(area: Area, points: Array) -> None:
        witness = best_witness(runner, area, points)
        if witness is not None and _holds(witness, query, runner):
            raise _Found(witness)

    bound = _widths if controller is None else _by_lines(controller)
    at_a_time = 1 if controller is None else BATCH
    try:
        for area, mine in zip(asked_areas, cases, strict=True):
            if not mine:  # a smaller box answers for it
                trees.append(Tree([-1], [0.0]))
                continue
            confirm = _Confirm(asked, mine, margins)
            trees.append(divide(area, bound, confirm, began + timeout, look, at_a_time))
    except _Found as error:
        return _sat(answer, error.witness, query, runner)
    except OutOfTime as error:
        return answer("unknown", leaves=len(margins), note=str(error) or "out of time")
    if certificate is not None:
        hashes = Hashes(hashlib.sha256(model).hexdigest(), hashlib.sha256(text).hexdigest())
        ends = _ends(asked_areas, asked.question.inputs)
        write_certificate(certificate, hashes, ends, trees)
    return answer("unsat", margin_lower=min(margins, default=None), leaves=len(margins))


def _controller(model: bytes, onnx: Path) -> Controller | None:
    """Return a chain of layers; None for another graph."""
    try:
        return parse_controller(model, str(onnx))
    except BadInput:
        return None


def _ends(found: list[Area], inputs: int) -> tuple[Array, Array]:
    ends = [np.array([getattr(area, end) for area in found]) for end in ("lower", "upper")]
    return ends[0].reshape(-1, inputs), ends[1].reshape(-1, inputs)


def _holds(found: Witness, query: Query, runner: Runner) -> bool:
    """Tell whether inputs fulfil a query when the network is run on them alone, strictly if asked.

    Among others onnxruntime may round otherwise.
    """
    outputs = runner.outputs(found.point[None])[0]
    if not np.isfinite(outputs).all():
        return False
    values = [[Fraction(x) for x in side.tolist()] for side in (found.point, outputs)]
    return evaluate(query, values).holds


def _sat(answer: Callable[..., Answer], found: Witness, query: Query, runner: Runner) -> Answer:
    outputs = runner.outputs(found.point[None])[0]
    text = write_witness(query, found.point, outputs)
    return answer("sat", margin_upper=-found.violation, witness=text)


def _by_lines(controller: Controller) -> Bound:
    lines = Lines(controller.layers)

    def bound(area: Area, lower: Array, upper: Array) -> Found:
        found = lines.bound(lower, upper, area.factors)
        points = found.corner.reshape(-1, lower.shape[1])
        return Found(found.least - area.most, found.loss, points)

    return bound


def _widths(area: Area, lower: Array, upper: Array) -> Found:
    """Know nothing of a graph: leave the bounds to the checker, and divide the widest input."""
    rows = len(area.most)
    share = (upper - lower) / np.maximum(area.upper - area.lower, 1e-300)
    score = np.broadcast_to(share[:, None, :], (len(lower), rows, lower.shape[1]))
    return Found(np.full((len(lower), rows), np.inf), score, (lower + upper) / 2)


class _Confirm:
    """Asks the checker about boxes, and notes the margins that it proves."""

    def __init__(self, asked: Asked, cases: list[Any], margins: list[float]) -> None:
        self._asked, self._cases, self._margins = asked, cases, margins

    def __call__(self, lower: Array, upper: Array) -> NDArray[np.bool_]:
        missed = excluded(self._asked, self._cases, lower, upper)
        proved = missed > 0
        self._margins += missed[proved].tolist()
        return proved

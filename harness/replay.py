"""The independent check of a witness.

The network is run by onnxruntime on the CPU in float32, one scan at a time; the plant is the
float64 model with exact arcs, judged in continuous time. As in VNN-COMP 2026 whatever a tool
says about outputs is ignored, a strict pass establishes sat, and a pass that needs the
tolerance earns the points and establishes nothing.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import ValidationError

from harness.answer import LARGEST_WITNESS, witness_in
from harness.machine import versions
from harness.records import WitnessCheck, WitnessOutcome
from racecar.closed_loop import State, simulate
from racecar.controller import runtime_session
from racecar.errors import BadInput
from racecar.instance import (
    Instance,
    Witness,
    controller_path,
    load_instance,
    load_instance_controller,
    read_text,
)
from racecar.polygon import Array

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

#: Absolute; of every coordinate of the start (m, m/s, rad), and of the margin (m).
TOLERANCE = 1e-4

_COORDINATES = ("s", "f", "v", "theta")


class Malformed(Exception):
    """A witness that cannot be read; the message says why."""


def parse_witness(text: bytes) -> Witness:
    """Read a witness; Malformed if that fails."""
    if len(text) > LARGEST_WITNESS:
        raise Malformed(f"it is longer than {LARGEST_WITNESS} bytes")
    try:
        return Witness.model_validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(x) for x in first["loc"])
        raise Malformed(f"{place + ': ' if place else ''}{first['msg']}") from None


@dataclass(frozen=True)
class Position:
    """Where a start lies relative to the initial set; doubles are compared exactly.

    distance: the largest distance of a coordinate from the set, in its own unit; within:
    whether no coordinate is farther away than the tolerance.
    """

    distance: float
    within: bool

    @property
    def inside(self) -> bool:
        """Whether the start lies in the set, without any tolerance."""
        return self.distance == 0


def position(instance: Instance, witness: Witness) -> Position:
    """Return where the start lies."""
    start = np.array([getattr(witness, name) for name in _COORDINATES])
    lower, upper = instance.initial_set.bounds()
    distance = float(np.max(np.maximum(np.maximum(lower - start, start - upper), 0.0)))
    within = np.all((start >= lower - TOLERANCE) & (start <= upper + TOLERANCE))
    return Position(distance, bool(within))


class Replayer:
    """Replays starts of one instance. Raises BadInput if its controller is not the right one."""

    def __init__(self, instance: Instance, spec: Path) -> None:
        self.instance = instance
        load_instance_controller(instance, spec)
        self._session = runtime_session(controller_path(instance, spec))
        self._plant, self._safety = instance.make_plant(), instance.make_property()

    def margins(self, starts: Array) -> Array:
        """Return the least margin (m) in continuous time of each start, ``[batch, 4]``.

        Exact for a batch of one; in larger batches onnxruntime may sum in another order.
        """
        state = State.start(*starts.T)
        with np.errstate(invalid="ignore", over="ignore"):
            runs = simulate(
                self._plant,
                lambda scan: _steer(self._session, scan),
                self._safety,
                state,
                self.instance.steps,
            )
        return runs.margin

    def margin(self, witness: Witness) -> float:
        """Return the least margin (m) of the run that begins at the witness."""
        start = [[getattr(witness, name) for name in _COORDINATES]]
        return float(self.margins(np.array(start))[0])


def _steer(session: InferenceSession, scan: Array) -> Array:
    rows = np.ascontiguousarray(scan.T, dtype=np.float32)
    (steering,) = session.run(None, {session.get_inputs()[0].name: rows})
    return np.asarray(steering, dtype=float)[:, 0]


def judge(start: Position, margin: float) -> WitnessOutcome:
    """Return what a start with that margin (m) amounts to."""
    if not start.within:
        return WitnessOutcome.OUT_OF_BOX
    if start.inside and margin <= 0:
        return WitnessOutcome.CORRECT
    if margin <= TOLERANCE:
        return WitnessOutcome.CORRECT_WITH_TOLERANCE
    return WitnessOutcome.WRONG


def check_witness(
    instance: Instance, spec: Path, text: bytes, replayer: Replayer | None = None
) -> WitnessCheck:
    """Check what a tool wrote after ``sat`` for the instance at ``spec``.

    Raises BadInput if the instance itself cannot be used.
    """
    start, margin = None, math.nan
    if not text.strip():
        outcome, message = WitnessOutcome.MISSING, "nothing follows sat"
    else:
        try:
            witness = parse_witness(text)
        except Malformed as error:
            outcome, message = WitnessOutcome.MALFORMED, str(error)
        else:
            start = position(instance, witness)
            # A start that is far outside is not replayed: it may lie anywhere.
            if start.within:
                margin = (replayer or Replayer(instance, spec)).margin(witness)
            outcome = judge(start, margin)
            message = _describe(outcome, start, margin)
    return WitnessCheck(
        instance=instance.id,
        outcome=outcome,
        message=message,
        margin=margin if math.isfinite(margin) else None,
        outside=start.distance if start else None,
        witness_sha256=hashlib.sha256(text).hexdigest(),
        spec_sha256=hashlib.sha256(read_text(spec)).hexdigest(),
        onnx_sha256=instance.controller.sha256,
        checked_with=versions(),
    )


def _describe(outcome: WitnessOutcome, start: Position, margin: float) -> str:
    parts = []
    if not start.inside:
        parts.append(f"the start lies {start.distance:.3g} outside the initial set")
    if start.within and math.isnan(margin):
        parts.append("the network returned a value that is not finite")
    elif start.within:
        parts.append(f"least margin {margin:.6g} m")
    if outcome is WitnessOutcome.CORRECT_WITH_TOLERANCE:
        parts.append(f"the tolerance is {TOLERANCE:g}")
    return "; ".join(parts)


def check_file(spec: Path, path: Path) -> WitnessCheck:
    """Check a witness file (or a result file) against an instance file; BadInput for bad files."""
    instance = load_instance(spec)
    try:
        with path.open("rb") as file:
            content = file.read(2 * LARGEST_WITNESS)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
    return check_witness(instance, spec, witness_in(content))


def format_witness(witness: Witness) -> str:
    """Return the text that stands after ``sat``; every number reads back as the same double."""
    return json.dumps(witness.model_dump()) + "\n"

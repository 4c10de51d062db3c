"""The independent check of a witness.

The network is run by onnxruntime on the CPU in float32, one scan at a time; the plant is the
float64 model with exact arcs, judged in continuous time. As in VNN-COMP 2026 whatever a tool
says about outputs is ignored, a strict pass establishes sat, and a pass that needs the
tolerance earns the points and establishes nothing.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from harness.answer import LARGEST_WITNESS, read_witness
from harness.given import Malformed, check_shape, complaint, given_steps, make_faults
from harness.machine import versions
from harness.records import WitnessCheck, WitnessOutcome
from racecar import witness as witness_file
from racecar.closed_loop import Disturb, State, simulate
from racecar.controller import runtime_session
from racecar.errors import BadInput
from racecar.instance import (
    Instance,
    controller_path,
    load_instance,
    load_instance_controller,
    read_text,
)
from racecar.polygon import Array
from racecar.witness import Witness

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

#: Absolute; of every coordinate of the start (m, m/s, rad), of noise (m), of the margin (m).
TOLERANCE = 1e-4

_COORDINATES = ("s", "f", "v", "theta")


def parse_witness(text: bytes) -> Witness:
    """Read a witness; Malformed if that fails."""
    if len(text) > LARGEST_WITNESS:
        raise Malformed(f"it is longer than {LARGEST_WITNESS} bytes")
    try:
        return witness_file.parse_witness(text)
    except BadInput as error:
        raise Malformed(str(error)) from None


@dataclass(frozen=True)
class Position:
    """Where a witness lies relative to what the instance allows; doubles are compared exactly.

    distance: the largest distance of a coordinate of the start from the initial set, in its own
    unit; noise: by how much (m) the largest noise is too large; refused: why the missing rays or
    the mirror are not allowed, if they are not; within: whether no number is off by more than
    the tolerance.
    """

    distance: float
    noise: float
    refused: str | None
    within: bool

    @property
    def inside(self) -> bool:
        """Whether the instance allows the witness, without any tolerance."""
        return self.distance == 0 and self.noise == 0 and self.refused is None

    @property
    def outside(self) -> float | None:
        """The largest distance of a number from what is allowed; None if a choice is not."""
        return max(self.distance, self.noise) if self.refused is None else None


def position(instance: Instance, witness: Witness) -> Position:
    """Return where a witness lies; Malformed if it has not the shape that the instance asks."""
    check_shape(instance, witness)
    start = np.array([getattr(witness, name) for name in _COORDINATES])
    lower, upper = instance.initial_set.bounds()
    distance = float(np.max(np.maximum(np.maximum(lower - start, start - upper), 0.0)))
    within = bool(np.all((start >= lower - TOLERANCE) & (start <= upper + TOLERANCE)))
    refused, excess = complaint(instance, witness), 0.0
    if witness.noise and instance.disturbance is not None:
        bound = instance.disturbance.noise
        largest = float(np.max(np.abs(witness.noise)))
        excess = max(largest - bound, 0.0)
        within = within and largest <= bound + TOLERANCE
    return Position(distance, excess, refused, within and refused is None)


class Replayer:
    """Replays starts of one instance. Raises BadInput if its controller is not the right one."""

    def __init__(self, instance: Instance, spec: Path) -> None:
        self.instance = instance
        load_instance_controller(instance, spec)
        self._session = runtime_session(controller_path(instance, spec))
        self._plant, self._safety = instance.make_plant(), instance.make_property()

    def margins(
        self, starts: Array, disturb: Disturb | None = None, steps: int | None = None
    ) -> Array:
        """Return the least margin (m) in continuous time of each start, ``[batch, 4]``.

        disturb: of the scans; steps: how many control periods, if not the instance's. Exact for
        a batch of one; in larger batches onnxruntime may sum in another order.
        """
        state = State.start(*starts.T)
        with np.errstate(invalid="ignore", over="ignore"):
            runs = simulate(
                self._plant,
                lambda scan: _steer(self._session, scan),
                self._safety,
                state,
                self.instance.steps if steps is None else steps,
                disturb,
            )
        return runs.margin

    def margin(self, witness: Witness) -> float:
        """Return the least margin (m) of the run that a witness describes.

        Raises Malformed if its lists end before the run does, and the run is not unsafe by then.
        """
        start = np.array([[getattr(witness, name) for name in _COORDINATES]])
        steps = given_steps(self.instance, witness)
        margin = float(self.margins(start, make_faults(self.instance, witness), steps)[0])
        if steps < self.instance.steps and margin > TOLERANCE:
            raise Malformed(
                f"it gives values for {steps} of {self.instance.steps} steps, "
                "and the car is safe until then"
            )
        return margin


def _steer(session: InferenceSession, scan: Array) -> Array:
    rows = np.ascontiguousarray(scan.T, dtype=np.float32)
    (steering,) = session.run(None, {session.get_inputs()[0].name: rows})
    return np.asarray(steering, dtype=float)[:, 0]


def judge(place: Position, margin: float) -> WitnessOutcome:
    """Return what a witness at that place, with that margin (m), amounts to."""
    if not place.within:
        return WitnessOutcome.OUT_OF_BOX
    if place.inside and margin <= 0:
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
    place, margin = None, math.nan
    if not text.strip():
        outcome, message = WitnessOutcome.MISSING, "nothing follows sat"
    else:
        try:
            witness = parse_witness(text)
            place = position(instance, witness)
            # A start that is far outside is not replayed: it may lie anywhere.
            if place.within:
                margin = (replayer or Replayer(instance, spec)).margin(witness)
            outcome = judge(place, margin)
            message = _describe(outcome, place, margin)
        except Malformed as error:
            outcome, message, place = WitnessOutcome.MALFORMED, str(error), None
    return WitnessCheck(
        instance=instance.id,
        outcome=outcome,
        message=message,
        margin=margin if math.isfinite(margin) else None,
        outside=place.outside if place else None,
        witness_sha256=hashlib.sha256(text).hexdigest(),
        spec_sha256=hashlib.sha256(read_text(spec)).hexdigest(),
        onnx_sha256=instance.controller.sha256,
        checked_with=versions(),
    )


def _describe(outcome: WitnessOutcome, place: Position, margin: float) -> str:
    parts = []
    if place.distance > 0:
        parts.append(f"the start lies {place.distance:.3g} outside the initial set")
    if place.noise > 0:
        parts.append(f"the noise is {place.noise:.3g} m too large")
    if place.refused is not None:
        parts.append(place.refused)
    if place.within and math.isnan(margin):
        parts.append("the network returned a value that is not finite")
    elif place.within:
        parts.append(f"least margin {margin:.6g} m")
    if outcome is WitnessOutcome.CORRECT_WITH_TOLERANCE:
        parts.append(f"the tolerance is {TOLERANCE:g}")
    return "; ".join(parts)


def check_file(spec: Path, path: Path) -> WitnessCheck:
    """Check a witness file (or a result file) against an instance file; BadInput for bad files."""
    return check_witness(load_instance(spec), spec, read_witness(path))

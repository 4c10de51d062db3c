"""The independent check of a witness of a VNN-LIB query.

As in VNN-COMP 2026: the network is run by onnxruntime on the CPU, what the witness says about
outputs is ignored, inputs may be off by the tolerance, outputs by nothing. Unlike there bounds
are compared exactly with the inputs that the network really gets.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from harness.answer import LARGEST_WITNESS
from harness.given import Malformed
from harness.machine import versions
from harness.query.evaluate import TOLERANCE, Finding, Place, evaluate, place_inputs
from harness.query.network import CannotRun, Network, exact, read_unpacked
from harness.query.read import NotUnderstood, read_query
from harness.query.terms import Query
from harness.query.witness import read_inputs
from harness.records import WitnessCheck, WitnessOutcome
from racecar.errors import BadInput


@dataclass(frozen=True)
class Judged:
    """What a witness amounts to; numbers as in WitnessCheck."""

    outcome: WitnessOutcome
    message: str
    outside: float | None = None
    violation: float | None = None


def check_query_witness(instance: str, onnx: Path, spec: Path, text: bytes) -> WitnessCheck:
    """Check what a tool wrote after ``sat`` for a query.

    instance: its ID; onnx, spec: files, gzipped or not. Raises BadInput if they cannot be used.
    """
    network, query = read_unpacked(onnx), read_unpacked(spec)
    if not text.strip():
        judged = Judged(WitnessOutcome.MISSING, "nothing follows sat")
    else:
        try:
            judged = judge_witness(_query(query, str(spec)), network, str(onnx), text)
        except NotUnderstood as error:
            judged = Judged(WitnessOutcome.UNSUPPORTED, str(error))
    return WitnessCheck(
        instance=instance,
        outcome=judged.outcome,
        message=judged.message,
        outside=judged.outside,
        violation=judged.violation,
        witness_sha256=hashlib.sha256(text).hexdigest(),
        spec_sha256=hashlib.sha256(query).hexdigest(),
        onnx_sha256=hashlib.sha256(network).hexdigest(),
        checked_with=versions(),
    )


@lru_cache(maxsize=8)
def _query(content: bytes, where: str) -> Query:
    try:
        return read_query(content.decode("utf-8"), where)
    except UnicodeDecodeError:
        raise BadInput(f"{where}: it is not text") from None


def judge_witness(query: Query, network: bytes, where: str, text: bytes) -> Judged:
    """Judge a witness; network: an ONNX file's content, called ``where`` in errors."""
    runner = Network(network, query, where)
    try:
        if len(text) > LARGEST_WITNESS:
            raise Malformed(f"it is longer than {LARGEST_WITNESS} bytes")
        fed = runner.feed(read_inputs(text, query))
    except Malformed as error:
        return Judged(WitnessOutcome.MALFORMED, str(error))
    inputs, rounding = exact(fed), fed[0].dtype.type
    place = place_inputs(query, inputs, rounding)
    outside = place.outside if math.isfinite(place.outside) else None
    if not place.within:
        return Judged(WitnessOutcome.OUT_OF_BOX, _describe_place(place), outside)
    try:
        outputs = runner.run(fed)
    except CannotRun as error:
        return Judged(WitnessOutcome.UNSUPPORTED, f"the network cannot be run ({error})", outside)
    if not all(np.isfinite(output).all() for output in outputs):
        message = "the network returned a value that is not finite"
        return Judged(WitnessOutcome.WRONG, message, outside)
    finding = evaluate(query, [*inputs, *exact(outputs)], rounding)
    outcome = _outcome(finding)
    violation = finding.violation if math.isfinite(finding.violation) else None
    return Judged(outcome, _describe(outcome, place, finding), outside, violation)


def _outcome(finding: Finding) -> WitnessOutcome:
    if finding.holds:
        return WitnessOutcome.CORRECT
    if finding.within:
        return WitnessOutcome.CORRECT_WITH_TOLERANCE
    return WitnessOutcome.WRONG


def _describe_place(place: Place) -> str:
    if place.allowed:
        return ""
    if not math.isfinite(place.outside):
        return "the inputs are not allowed"
    if place.outside == 0:
        return "an input lies on a bound that excludes it"
    where = f" (line {place.line})" if place.line else ""
    return f"an input lies {place.outside:.3g} outside{where}"


def _describe(outcome: WitnessOutcome, place: Place, finding: Finding) -> str:
    parts = [_describe_place(place)]
    if math.isfinite(finding.violation):
        verb = "meet" if finding.violation >= 0 else "miss"
        parts.append(f"the outputs {verb} the condition by {abs(finding.violation):.6g}")
    if outcome is WitnessOutcome.CORRECT_WITH_TOLERANCE:
        parts.append(f"the tolerance on inputs is {float(TOLERANCE):g}")
    return "; ".join(part for part in parts if part) or "the inputs alone decide"

"""Say in plain words why a result got its points.

The same records, checks and judgements that the score is made of, with their numbers.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from harness.catalogue import Reference
from harness.evidence import Evidence
from harness.records import (
    NO_RESULT,
    PREPARE_ERROR,
    PREPARE_TIMEOUT,
    RUN_ERROR,
    RUN_TIMEOUT,
    Record,
    Verdict,
    WitnessCheck,
    WitnessOutcome,
)
from harness.scoring import Judgement, Scores
from racecar.errors import BadInput

_CODES = {
    RUN_TIMEOUT: "It was still running at its limit, or ended with status 124",
    PREPARE_TIMEOUT: "prepare_instance.sh was still running at its limit",
    NO_RESULT: "It ended well but left no answer",
    PREPARE_ERROR: "prepare_instance.sh failed",
    RUN_ERROR: "It ended with an error, so what it wrote does not count",
}


@dataclass(frozen=True)
class Explanation:
    """What one tool got for one instance, and why, a sentence each."""

    record: Record
    check: WitnessCheck | None
    judgement: Judgement
    sentences: tuple[str, ...]


def explain(
    instance: str, evidence: Evidence, scores: Scores
) -> tuple[str, tuple[Explanation, ...]]:
    """Return what is known of an instance by reference, and an explanation for every result.

    BadInput if no run has a result for it.
    """
    group = [
        (record, check, judgement)
        for (record, check), judgement in zip(
            evidence.checked, _in_order(evidence, scores), strict=True
        )
        if record.instance == instance
    ]
    if not group:
        known = sorted({record.instance for record, _ in evidence.checked})
        near = difflib.get_close_matches(instance, known, 1, 0.4) or known[:1]
        raise BadInput(f"no run has a result for instance {instance}; one for {near[0]} is there")
    reference = evidence.references.get(instance)
    provers = [_evidence(r, c) for r, c, j in group if j.claim.proves_sat]
    hints = [
        _evidence(r, c)
        for r, c, j in group
        if c and c.credited and j.claim.counted is Verdict.SAT and not j.claim.proves_sat
    ]
    return _describe(reference), tuple(
        Explanation(
            record,
            check,
            judgement,
            (_answered(record, judgement), *_why(judgement, check, provers, hints, reference)),
        )
        for record, check, judgement in group
    )


def _in_order(evidence: Evidence, scores: Scores) -> Iterator[Judgement]:
    judged = {(j.claim.tool, j.claim.instance): j for j in scores.judgements}
    for record, _ in evidence.checked:
        yield judged[record.tool, record.instance]


def _describe(reference: Reference | None) -> str:
    if reference is None:
        return "There is no reference result."
    parts = [f"The reference result is {reference.verdict}"]
    if reference.margin_lower is not None:
        parts.append(f"proved margin at least {reference.margin_lower:.6g}")
    if reference.margin_upper is not None:
        parts.append(f"best witness with margin {reference.margin_upper:.6g}")
    return "; ".join(parts) + "."


def _answered(record: Record, judgement: Judgement) -> str:
    limit = f"of {record.limits.wall_s:g} s that it had"
    counted = judgement.claim.counted
    if record.verdict in (Verdict.SAT, Verdict.UNSAT) and counted is Verdict.TIMEOUT:
        return (
            f"It answered {record.verdict} after {record.run_time:.2f} s, later than the "
            f"{record.limits.wall_s:g} s that it had: a timeout."
        )
    if record.result == record.verdict:
        said = f"It answered {record.verdict}"
    else:
        code = next((text for start, text in _CODES.items() if record.result.startswith(start)), "")
        said = f"{code or 'It gave no answer'} ({record.result}), which counts as {record.verdict},"
    detail = f" ({record.detail})" if record.detail else ""
    return f"{said} after {record.run_time:.2f} s {limit}{detail}."


def _why(
    judgement: Judgement,
    check: WitnessCheck | None,
    provers: Sequence[str],
    hints: Sequence[str],
    reference: Reference | None,
) -> Iterator[str]:
    claim = judgement.claim
    if claim.counted is Verdict.TIMEOUT or claim.verdict not in (Verdict.SAT, Verdict.UNSAT):
        yield "That is no claim, so it earns and costs nothing."
    elif claim.verdict is Verdict.SAT:
        outcome = claim.witness or WitnessOutcome.MISSING
        found = f": {check.message}" if check and check.message else ""
        yield f"The check of its witness found {outcome}{found}."
        yield outcome.sentence
    elif judgement.incorrect:
        for prover in provers:
            yield f"Refuted by {prover}."
        if not provers:
            yield "Refuted by the reference result's witness, which reaches the unsafe set."
    else:
        yield "Nothing shows the instance to be sat, so unsat counts as correct."
        if reference is not None and reference.verdict is Verdict.UNSAT:
            yield "The reference result says the same."
        for hint in hints:
            yield f"Against it stands {hint}, which counts with the tolerance only: no proof."
        if reference is not None and reference.verdict is Verdict.SAT:
            yield "The reference result says sat, but has no witness that reaches the unsafe set."


def _evidence(record: Record, check: WitnessCheck | None) -> str:
    return f"the witness of {record.tool} ({check.message if check else 'not checked'})"

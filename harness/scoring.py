"""VNN-COMP's scoring, as pure functions over typed claims.

10 points for a correct sat or unsat, -150 for an incorrect one, 0 for anything else; per
category the percent of the best tool's points; the percents summed. What is correct:

- sat: its witness passed the check, strictly or with tolerance (there is no other proof of it);
  one that the harness cannot check counts as unknown;
- unsat: nobody has shown the instance to be sat, neither a tool with a strict witness nor the
  reference with one.

Verdicts that contradict each other where nothing proves either are listed and cost nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar

from pydantic import ConfigDict

from harness.catalogue import Reference
from harness.records import Verdict, WitnessOutcome

CORRECT, INCORRECT, NOTHING = 10, -150, 0
OVERALL = "overall"


@dataclass(frozen=True)
class Claim:
    """What one tool says of one instance; times in seconds.

    witness: what the check of a sat's witness found.
    """

    tool: str
    category: str
    instance: str
    verdict: Verdict
    run_time: float
    timeout: float
    witness: WitnessOutcome | None = None

    @property
    def counted(self) -> Verdict:
        """The verdict that counts.

        An answer after the limit is a timeout, a sat that cannot be judged is unknown.
        """
        if self.run_time > self.timeout:
            return Verdict.TIMEOUT
        unsupported = self.witness is WitnessOutcome.UNSUPPORTED
        return Verdict.UNKNOWN if self.verdict is Verdict.SAT and unsupported else self.verdict

    @property
    def proves_sat(self) -> bool:
        """Whether it comes with a strict witness."""
        sat = self.counted is Verdict.SAT
        return sat and self.witness is not None and self.witness.establishes_sat


@dataclass(frozen=True)
class Judgement:
    """What a claim earns, and why."""

    claim: Claim
    points: int
    reason: str

    @property
    def solved(self) -> bool:
        """Whether the claim is a correct sat or unsat."""
        return self.points > 0

    @property
    def incorrect(self) -> bool:
        """Whether the claim is an incorrect sat or unsat."""
        return self.points < 0


class Conflict(StrEnum):
    """How verdicts on one instance can be at odds."""

    REFERENCE_REFUTED = "reference_refuted"
    REFUTED = "refuted"
    UNSETTLED = "unsettled"

    @property
    def sentence(self) -> str:
        """What it means."""
        return _CONFLICTS[self]


_CONFLICTS = {
    Conflict.REFERENCE_REFUTED: (
        "A replayed witness refutes the REFERENCE result unsat: "
        "the reference verifier or the instance is broken."
    ),
    Conflict.REFUTED: "A tool's unsat is refuted by a witness; it is incorrect.",
    Conflict.UNSETTLED: "Verdicts differ and nothing proves either; nobody is punished.",
}


@dataclass(frozen=True)
class Contradiction:
    """Verdicts on one instance that cannot both be right."""

    kind: Conflict
    category: str
    instance: str
    sat: tuple[str, ...]
    unsat: tuple[str, ...]

    def __str__(self) -> str:
        sides = f"sat: {', '.join(self.sat)}; unsat: {', '.join(self.unsat)}"
        return f"{self.category}/{self.instance}: {self.kind.sentence} ({sides})"


@dataclass(frozen=True)
class Row:
    """One tool's result in one category, or overall; a submission holds such rows.

    sat, unsat: correct ones; incorrect: unsat that a witness refutes (refuted), and sat whose
    witness does not hold (bad_witness); missing: instances that it was not run on though another
    tool was; par2_s: mean over all instances of the time of a correct answer, or twice the limit;
    unique: instances that it alone solved.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")

    tool: str
    category: str
    score: int
    percent: float
    sat: int
    unsat: int
    incorrect: int
    refuted: int
    bad_witness: int
    unknown: int
    timeout: int
    error: int
    missing: int
    instances: int
    par2_s: float
    unique: tuple[str, ...]


@dataclass(frozen=True)
class Scores:
    """The outcome: rows per tool and category, the overall ones last, and what is at odds."""

    rows: tuple[Row, ...]
    judgements: tuple[Judgement, ...]
    contradictions: tuple[Contradiction, ...]

    @property
    def reference_refuted(self) -> bool:
        """Whether some reference result is wrong."""
        return any(c.kind is Conflict.REFERENCE_REFUTED for c in self.contradictions)

    def by_kind(self, tool: str | None = None, category: str | None = None) -> dict[Conflict, int]:
        """Count the contradictions of every kind: all, or those of a tool or a category."""
        counts = dict.fromkeys(Conflict, 0)
        for found in self.contradictions:
            if tool in (None, *found.sat, *found.unsat) and category in (None, found.category):
                counts[found.kind] += 1
        return counts


def score(claims: Sequence[Claim], references: Mapping[str, Reference]) -> Scores:
    """Score all tools; at most one claim per tool and instance, references by instance."""
    instances: defaultdict[str, list[Claim]] = defaultdict(list)
    for claim in claims:
        instances[claim.instance].append(claim)
    judgements, contradictions = [], []
    for instance, group in instances.items():
        reference = references.get(instance)
        judgements += [judge(claim, group, reference) for claim in group]
        contradictions += find_contradictions(group, reference)
    return Scores(_rows(judgements), tuple(judgements), tuple(contradictions))


def judge(claim: Claim, group: Sequence[Claim], reference: Reference | None) -> Judgement:
    """Judge one claim against all claims on the same instance and its reference result."""
    verdict = claim.counted
    if verdict is Verdict.SAT:
        outcome = claim.witness or WitnessOutcome.MISSING
        points = CORRECT if outcome.credited else INCORRECT
        return Judgement(claim, points, f"witness: {outcome}")
    if verdict is Verdict.UNSAT:
        prover = next((other.tool for other in group if other.proves_sat), None)
        if prover is not None:
            return Judgement(claim, INCORRECT, f"refuted by the witness of {prover}")
        if reference is not None and reference.proves_sat:
            return Judgement(claim, INCORRECT, "refuted by the reference's witness")
        return Judgement(claim, CORRECT, "not refuted")
    unsupported = claim.witness is WitnessOutcome.UNSUPPORTED and verdict is Verdict.UNKNOWN
    return Judgement(claim, NOTHING, f"witness: {claim.witness}" if unsupported else str(verdict))


#: How the reference result is named beside tools (a tool's name has no space).
_REFERENCE = "the reference result"


def find_contradictions(group: Sequence[Claim], reference: Reference | None) -> list[Contradiction]:
    """Return how the claims on one instance, and its reference result, are at odds.

    A sat whose witness failed contradicts nobody: it is no evidence at all.
    """
    proofs = [claim.tool for claim in group if claim.proves_sat]
    hints = [
        claim.tool
        for claim in group
        if claim.counted is Verdict.SAT and claim.witness and claim.witness.credited
        and not claim.proves_sat
    ]  # fmt: skip
    unsat = [claim.tool for claim in group if claim.counted is Verdict.UNSAT]
    reference_unsat = reference is not None and reference.verdict is Verdict.UNSAT
    if reference is not None and reference.verdict is Verdict.SAT:
        (proofs if reference.proves_sat else hints).append(_REFERENCE)

    def found(kind: Conflict, sat: Iterable[str], against: Iterable[str]) -> Contradiction:
        first = group[0]
        return Contradiction(kind, first.category, first.instance, tuple(sat), tuple(against))

    contradictions = []
    if proofs and reference_unsat:
        contradictions.append(found(Conflict.REFERENCE_REFUTED, proofs, [_REFERENCE]))
    if proofs and unsat:
        contradictions.append(found(Conflict.REFUTED, proofs, unsat))
    against = unsat + ([_REFERENCE] if reference_unsat else [])
    if hints and against and not proofs:
        contradictions.append(found(Conflict.UNSETTLED, hints, against))
    return contradictions


@dataclass
class _Sum:
    """Counts of one tool over some instances."""

    score: int = 0
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    time: float = 0.0
    unique: list[str] = field(default_factory=list)
    percent: float = 0.0

    def add(self, judgement: Judgement | None, limit: float) -> None:
        if judgement is None:
            self.counts["missing"] += 1
            self.time += 2 * limit
            return
        self.score += judgement.points
        verdict = str(judgement.claim.counted)
        if judgement.incorrect:
            self.counts["refuted" if verdict == Verdict.UNSAT else "bad_witness"] += 1
            verdict = "incorrect"
        self.counts[verdict] += 1
        self.time += judgement.claim.run_time if judgement.solved else 2 * limit


def _rows(judgements: Sequence[Judgement]) -> tuple[Row, ...]:
    tools = list(dict.fromkeys(j.claim.tool for j in judgements))
    by_claim = {(j.claim.tool, j.claim.instance): j for j in judgements}
    categories: dict[str, dict[str, float]] = {}
    solvers: defaultdict[str, set[str]] = defaultdict(set)
    for judgement in judgements:
        claim = judgement.claim
        limits = categories.setdefault(claim.category, {})
        limits[claim.instance] = max(claim.timeout, limits.get(claim.instance, 0.0))
        if judgement.solved:
            solvers[claim.instance].add(claim.tool)
    overall = {tool: _Sum() for tool in tools}
    rows = []
    for category in sorted(categories):
        limits = categories[category]
        sums = {tool: _Sum() for tool in tools}
        for instance, limit in limits.items():
            for tool in tools:
                result = by_claim.get((tool, instance))
                sums[tool].add(result, limit)
                overall[tool].add(result, limit)
        present = [t for t in tools if sums[t].counts["missing"] < len(limits)]
        best = max(sums[tool].score for tool in present)
        for tool in present:
            if best > 0:
                sums[tool].percent = max(0.0, 100.0 * sums[tool].score / best)
            if len(present) > 1:
                sums[tool].unique = sorted(i for i in limits if solvers[i] == {tool})
            overall[tool].percent += sums[tool].percent
            overall[tool].unique += sums[tool].unique
        rows += _ranked(category, {tool: sums[tool] for tool in present}, len(limits))
    total = sum(len(limits) for limits in categories.values())
    return (*rows, *_ranked(OVERALL, overall, total))


def _ranked(category: str, sums: Mapping[str, _Sum], instances: int) -> list[Row]:
    rows = [
        Row(
            tool=tool,
            category=category,
            score=total.score,
            percent=total.percent,
            sat=total.counts["sat"],
            unsat=total.counts["unsat"],
            incorrect=total.counts["incorrect"],
            refuted=total.counts["refuted"],
            bad_witness=total.counts["bad_witness"],
            unknown=total.counts["unknown"],
            timeout=total.counts["timeout"],
            error=total.counts["error"],
            missing=total.counts["missing"],
            instances=instances,
            par2_s=total.time / instances,
            unique=tuple(total.unique),
        )
        for tool, total in sums.items()
    ]
    return sorted(rows, key=lambda row: (-row.percent, -row.score, row.par2_s, row.tool))

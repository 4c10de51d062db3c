"""Make reference results: run what may settle the most first, and carry over what follows."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version

from generator.reference.implied import implies
from generator.reference.rows import Row, sha256
from generator.reference.runs import Outcome, Work
from harness.catalogue import Entry
from harness.checks import judge_entry
from racecar.errors import BadInput
from racecar.instance import Instance, load_instance

PROGRAMS = ("closedlap", "numpy", "onnxruntime", "llvmlite", "python-flint")


class Contradiction(Exception):
    """A proof that the checker accepted, and a witness that the replay accepted, against it.

    One of the programs is wrong, and no result can be trusted before that is found.
    """

    def __init__(self, witness: str, asked: str, proof: str) -> None:
        super().__init__(
            f"{asked}: the witness of {witness} holds in the replay, and the certificate of "
            f"{proof} is accepted by the checker; one of them is wrong: nothing was written"
        )


@dataclass(frozen=True)
class Question:
    """An instance and where it lies."""

    entry: Entry
    instance: Instance

    @property
    def id(self) -> str:
        """The instance's ID."""
        return self.entry.id


@dataclass
class Results:
    """What is known: rows by instance, and the text of witnesses by instance."""

    rows: dict[str, Row] = field(default_factory=dict)
    witnesses: dict[str, str] = field(default_factory=dict)

    def settled(self, question: Question) -> bool:
        """Whether a verdict is known."""
        row = self.rows.get(question.id)
        return row is not None and row.verdict != "unknown"


def load_questions(entries: Iterable[Entry]) -> list[Question]:
    """Read instances; BadInput if one is broken or its ID is not its file's name."""
    questions = []
    for entry in entries:
        instance = load_instance(entry.spec)
        if instance.id != entry.id:
            raise BadInput(f"{entry.spec}: its id is {instance.id}; it must be the file's name")
        questions.append(Question(entry, instance))
    return questions


def make(questions: Sequence[Question], work: Work, report: Callable[[int, int], None]) -> Results:
    """Settle questions as far as the limits allow.

    report(settled or given up, all) is called after every round.
    """
    results, tried = Results(), set[str]()
    while todo := [q for q in questions if q.id not in tried and not results.settled(q)]:
        batch = largest(todo)
        tried |= {question.id for question in batch}
        _run_round(batch, questions, work, results)
        done = sum(q.id in tried or results.settled(q) for q in questions)
        report(done, len(questions))
    return results


def largest(questions: Sequence[Question]) -> list[Question]:
    """Return those that are implied by no other one; of equal ones the first."""
    groups = defaultdict(list)
    for question in questions:
        groups[question.instance.controller.sha256].append(question)
    found = []
    for group in groups.values():
        for i, asked in enumerate(group):
            above = (
                implies(other.instance, asked.instance)
                and (j < i or not implies(asked.instance, other.instance))
                for j, other in enumerate(group)
                if j != i
            )
            if not any(above):
                found.append(asked)
    return found


def _run_round(
    batch: Sequence[Question], questions: Sequence[Question], work: Work, results: Results
) -> None:
    outcomes = work.prove([question.entry for question in batch])
    # All before any witness, which may settle others of the batch, too.
    results.rows |= {q.id: open_row(q.id, outcomes[q.id]) for q in batch}
    proved = []
    for question in batch:
        outcome = outcomes[question.id]
        if work.certified(outcome):
            proved.append(question)
        elif outcome.witness is not None:
            _try_witness(question, outcome.witness, question, outcome, results)
            _spread_witness(question, questions, results)
    _check_refuted([q for q in proved if results.settled(q)], work, results)
    while proved := [question for question in proved if not results.settled(question)]:
        first = largest(proved)
        checks = work.check([question.entry for question in first])
        for question in first:
            take_check(question.id, checks[question.id], work, results)
            if results.settled(question):
                _spread_proof(question, questions, results)
        proved = [question for question in proved if question not in first]


def _check_refuted(proved: Sequence[Question], work: Work, results: Results) -> None:
    """Note that proofs are refuted by witnesses of other questions; they must not be accepted."""
    checks = work.check([question.entry for question in proved])
    for question in proved:
        row = results.rows[question.id]
        if checks[question.id].proved is not None:
            raise Contradiction(row.source, question.id, question.id)
        method = f"{row.method}, against a proof that was not accepted"
        results.rows[question.id] = replace(row, method=method)


def open_row(id: str, outcome: Outcome) -> Row:
    """Return the row of an instance of which nothing is proved yet."""
    record, upper = outcome.record, outcome.printed.get("margin_upper")
    return Row(
        instance=id,
        verdict="unknown",
        margin_lower="",
        margin_upper="" if upper is None else repr(upper),
        method=f"verifier: {record.verdict}",
        source="",
        evidence="",
        time_s=f"{record.run_time:.3f}",
        check_s="",
        versions="; ".join(f"{name} {version(name)}" for name in PROGRAMS),
    )


def take_check(id: str, check: Outcome, work: Work, results: Results) -> None:
    """Take a certificate for what the checker makes of it."""
    row, found, record = results.rows[id], check.printed, check.record
    verdict, lower = "unknown", ""
    if check.proved is not None and check.proved > 0:
        verdict, lower = "unsat", repr(check.proved)
        method = f"proof, checked in full ({found['rows']} rows)"
    elif found.get("verdict") == "rejected":
        method = f"proof, certificate rejected: {found['reason']}"
    else:
        method = f"proof, not checked within {record.limits.wall_s:g} s"
    evidence = sha256(work.certificate(id).read_bytes())
    results.rows[id] = replace(
        row, verdict=verdict, margin_lower=lower, method=method, source=id, evidence=evidence,
        check_s=f"{record.run_time:.3f}",
    )  # fmt: skip


def _spread_proof(proved: Question, questions: Sequence[Question], results: Results) -> None:
    """Carry a checked proof over to what it implies."""
    row = results.rows[proved.id]
    for asked in questions:
        own = results.rows.get(asked.id)
        if (own and own.verdict == "unsat") or not implies(proved.instance, asked.instance):
            continue
        if own and own.verdict == "sat":
            raise Contradiction(own.source, asked.id, proved.id)
        results.rows[asked.id] = replace(
            row,
            instance=asked.id,
            margin_upper=own.margin_upper if own else "",
            method=f"{row.method}, of a larger question",
            time_s=own.time_s if own else "",
            check_s="",
        )


def _spread_witness(found: Question, questions: Sequence[Question], results: Results) -> None:
    """Replay a witness on every question that its start may settle, or refute a proof of."""
    if not results.settled(found):
        return
    witness = results.witnesses[found.id].encode()
    for asked in questions:
        same = asked.instance.controller.sha256 == found.instance.controller.sha256
        row = results.rows.get(asked.id)
        if same and (row is None or row.verdict != "sat") and _starts_in(witness, asked.instance):
            _try_witness(asked, witness, found, None, results)


def _starts_in(witness: bytes, instance: Instance) -> bool:
    try:
        start = json.loads(witness)
        bounds = instance.initial_set.model_dump()
        return all(low <= start[name] <= high for name, (low, high) in bounds.items())
    except (ValueError, KeyError, TypeError):
        return False


def _try_witness(
    asked: Question, witness: bytes, source: Question, outcome: Outcome | None, results: Results
) -> None:
    """Settle a question by a witness if the harness's replay finds that it holds strictly."""
    check = judge_entry(asked.entry, witness)
    row = results.rows.get(asked.id)
    if not check.establishes_sat or check.margin is None:
        if outcome is not None and row is not None and not results.settled(asked):
            results.rows[asked.id] = replace(row, method=f"verifier: sat; witness {check.outcome}")
        return
    if row is not None and row.verdict == "unsat":
        raise Contradiction(source.id, asked.id, row.source)
    base = row or results.rows[source.id]
    own = asked.id == source.id
    results.witnesses[source.id] = witness.decode()
    results.rows[asked.id] = replace(
        base, instance=asked.id, verdict="sat", margin_lower="", margin_upper=repr(check.margin),
        method="witness, replayed" if own else "witness of another question, replayed",
        source=source.id, evidence=sha256(witness), time_s=row.time_s if row else "", check_s="",
    )  # fmt: skip

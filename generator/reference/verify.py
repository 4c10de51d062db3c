"""Verify reference results anew: certificates by the checker, witnesses by the replay."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from generator.reference.implied import implies
from generator.reference.make import Question
from generator.reference.rows import Row, sha256
from generator.reference.runs import Work
from harness.checks import judge_entry

#: A certificate made on another machine may prove so much (m) less.
ROOM = 1e-6


@dataclass(frozen=True)
class Found:
    """How a row fared; fault: what is wrong, empty if it holds."""

    instance: str
    verdict: str
    fault: str


def sample(rows: Iterable[Row], count: int | None, seed: int) -> list[Row]:
    """Return all rows, or so many of those with a verdict, drawn by ``seed``."""
    rows = list(rows)
    if count is None:
        return rows
    settled = [row for row in rows if row.verdict != "unknown"]
    return random.Random(seed).sample(settled, min(count, len(settled)))


def verify(
    rows: Sequence[Row], questions: Mapping[str, Question], witnesses: Mapping[str, str],
    work: Work, same_bytes: bool = False,
) -> list[Found]:  # fmt: skip
    """Verify rows; certificates that are not in the work folder are made again.

    questions: of all rows and of what they name as source; witnesses: by instance; same_bytes:
    a certificate with another hash than the row's is a fault even if it proves the row.
    """
    sources = {row.source: row for row in rows if row.verdict == "unsat"}
    known = [questions[name] for name in sources if name in questions]
    missing = [q.entry for q in known if not work.certificate(q.id).is_file()]
    work.prove(missing)
    claimed = {q.id: q for q in known if work.certificate(q.id).is_file()}
    checks = work.check_anew([q.entry for q in claimed.values()])
    proved = {
        name: outcome.proved for name, outcome in checks.items() if outcome.proved is not None
    }
    found = []
    for row in rows:
        if row.verdict == "unsat":
            fault = _proof_fault(row, questions, work, proved, same_bytes)
        elif row.verdict == "sat":
            fault = _witness_fault(row, questions, witnesses)
        else:
            fault = unknown_fault(row)
        found.append(Found(row.instance, row.verdict, fault))
    return found


def _proof_fault(
    row: Row,
    questions: Mapping[str, Question],
    work: Work,
    proved: Mapping[str, float],
    same_bytes: bool,
) -> str:
    if row.instance not in questions or row.source not in questions:
        return f"there is no instance {row.instance}, or no {row.source} that it names as source"
    file = work.certificate(row.source)
    if not file.is_file():
        return "its certificate is not there and could not be made again"
    same = sha256(file.read_bytes()) == row.evidence
    if same_bytes and not same:
        return f"{file}: its sha256 is not the one of the row"
    if row.source not in proved:
        return f"{file}: the checker does not accept it, or not in time"
    asked, source = questions[row.instance].instance, questions[row.source].instance
    if not implies(source, asked):
        return f"a proof of {row.source} does not prove it"
    return margin_fault(row, proved[row.source], same)


def margin_fault(row: Row, proved: float, same: bool) -> str:
    """Return what is wrong with the margin of a row; proved: the checker's (m).

    same: whether it is the row's own certificate. One made on another machine may prove a little
    less, as the last bits of matrix products differ.
    """
    room = 0.0 if same else ROOM
    if 0 < number(row.margin_lower) <= proved + room:
        return ""
    return f"margin_lower is {row.margin_lower}, proved is {proved!r}"


def _witness_fault(
    row: Row, questions: Mapping[str, Question], witnesses: Mapping[str, str]
) -> str:
    text = witnesses.get(row.source)
    if text is None or row.instance not in questions:
        return f"there is no instance {row.instance}, or no witness of {row.source}"
    if sha256(text.encode()) != row.evidence:
        return f"the sha256 of the witness of {row.source} is not the one of the row"
    check = judge_entry(questions[row.instance].entry, text.encode())
    if not check.establishes_sat or check.margin is None:
        return f"its witness: {check.outcome}: {check.message}"
    # The replay's last bits depend on the machine.
    if not math.isclose(number(row.margin_upper), check.margin, abs_tol=ROOM):
        return f"margin_upper is {row.margin_upper}, replayed is {check.margin!r}"
    return ""


def unknown_fault(row: Row) -> str:
    """Return what is wrong with a row that should be open."""
    if row.verdict != "unknown":
        return f"verdict is {row.verdict!r}"
    return "an open row has a proved margin" if row.margin_lower else ""


def number(text: str) -> float:
    """Return the number in a cell, NaN if there is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan

"""Reference results of VNN-LIB questions: each stands for itself, none implies another one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from generator.reference.make import Results, open_row, take_check
from generator.reference.rows import Row, sha256
from generator.reference.runs import Outcome, Work
from generator.reference.verify import ROOM, Found, margin_fault, number, unknown_fault
from harness.catalogue import Entry
from harness.checks import judge_entry


def make_queries(
    entries: Sequence[Entry], work: Work, report: Callable[[int, int], None]
) -> Results:
    """Settle questions as far as the limits allow.

    report(settled or given up, all) is called after the proofs and after the checks.
    """
    results = Results()
    outcomes = work.prove(entries)
    proved = []
    for entry in entries:
        outcome = outcomes[entry.id]
        results.rows[entry.id] = open_row(entry.id, outcome)
        if work.certified(outcome):
            proved.append(entry)
        elif outcome.witness is not None:
            _take_witness(entry, outcome, outcome.witness, results)
    report(len(entries) - len(proved), len(entries))
    checks = work.check(proved)
    for entry in proved:
        take_check(entry.id, checks[entry.id], work, results)
    report(len(entries), len(entries))
    return results


def _take_witness(entry: Entry, outcome: Outcome, witness: bytes, results: Results) -> None:
    """Settle a question by a witness if the harness's judge finds that it holds strictly."""
    check, row = judge_entry(entry, witness), results.rows[entry.id]
    if not check.establishes_sat or check.violation is None:
        row = replace(row, margin_upper="", method=f"verifier: sat; witness {check.outcome}")
    else:
        results.witnesses[entry.id] = witness.decode()
        row = replace(
            row, verdict="sat", margin_upper=repr(-check.violation), source=entry.id,
            method="witness, judged on the network", evidence=sha256(witness),
        )  # fmt: skip
    results.rows[entry.id] = row


def verify_queries(
    rows: Sequence[Row],
    entries: Mapping[str, Entry],
    witnesses: Mapping[str, str],
    work: Work,
    same_bytes: bool = False,
) -> list[Found]:
    """Verify rows; certificates that are not in the work folder are made again.

    entries, witnesses: by instance; same_bytes: a certificate with another hash than the row's is
    a fault even if it proves the row.
    """
    claimed = [entries[row.instance] for row in rows if row.verdict == "unsat"
               and row.instance in entries]  # fmt: skip
    work.prove([entry for entry in claimed if not work.certificate(entry.id).is_file()])
    there = [entry for entry in claimed if work.certificate(entry.id).is_file()]
    checks = work.check_anew(there)
    found = []
    for row in rows:
        if row.instance not in entries:
            fault = "there is no such instance"
        elif row.verdict == "unsat":
            fault = _proof_fault(row, checks.get(row.instance), work, same_bytes)
        elif row.verdict == "sat":
            fault = _witness_fault(row, entries[row.instance], witnesses)
        else:
            fault = unknown_fault(row)
        found.append(Found(row.instance, row.verdict, fault))
    return found


def _proof_fault(row: Row, check: Outcome | None, work: Work, same_bytes: bool) -> str:
    file = work.certificate(row.instance)
    if row.source != row.instance:
        return f"its source is {row.source}; a question stands for itself"
    if check is None:
        return "its certificate is not there and could not be made again"
    same = sha256(file.read_bytes()) == row.evidence
    if same_bytes and not same:
        return f"{file}: its sha256 is not the one of the row"
    if check.proved is None:
        return f"{file}: the checker does not accept it, or not in time"
    return margin_fault(row, check.proved, same)


def _witness_fault(row: Row, entry: Entry, witnesses: Mapping[str, str]) -> str:
    text = witnesses.get(row.source)
    if text is None or row.source != row.instance:
        return f"there is no witness of {row.source}, or it is of another question"
    if sha256(text.encode()) != row.evidence:
        return f"the sha256 of the witness of {row.source} is not the one of the row"
    check = judge_entry(entry, text.encode())
    if not check.establishes_sat or check.violation is None:
        return f"its witness: {check.outcome}: {check.message}"
    # onnxruntime's last bits depend on the machine.
    if not math.isclose(number(row.margin_upper), -check.violation, abs_tol=ROOM, rel_tol=ROOM):
        return f"margin_upper is {row.margin_upper}, judged is {-check.violation!r}"
    return ""

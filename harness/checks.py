"""The check that every sat needs: stored with the run, and good for exactly one witness."""

from __future__ import annotations

import hashlib
from pathlib import Path

from harness.catalogue import Entry, find_file, is_query, sha256
from harness.machine import versions
from harness.records import Record, Verdict, WitnessCheck
from harness.store import RunFolder
from racecar.errors import BadInput


def check_entry(entry: Entry, record: Record, witness: bytes) -> WitnessCheck:
    """Judge the witness of a record; BadInput if the instance is not the one that was run."""
    check = judge_entry(entry, witness)
    if (check.spec_sha256, check.onnx_sha256) != (record.spec_sha256, record.onnx_sha256):
        raise BadInput(
            f"{entry.spec}: the instance, or its network, is not the one that "
            f"{record.tool} was given; run it anew"
        )
    return check


def judge_entry(entry: Entry, witness: bytes) -> WitnessCheck:
    """Judge what follows ``sat`` for an instance; BadInput if its files cannot be used."""
    # Slow to import (onnxruntime), and needed for a witness only.
    if is_query(entry.spec):
        from harness.query.judge import check_query_witness  # noqa: PLC0415

        return check_query_witness(entry.id, entry.onnx, entry.spec, witness)
    from harness.replay import check_witness  # noqa: PLC0415
    from racecar.instance import load_instance  # noqa: PLC0415

    return check_witness(load_instance(entry.spec), entry.spec, witness)


def witness_check(
    folder: RunFolder, record: Record, root: Path | None, recheck: bool = False
) -> WitnessCheck | None:
    """Return the check of a record's witness; None if the record is not sat.

    A stored check holds for the witness and the files that it names, and for the versions that it
    was made with; made with others, it is believed only where the instance is not at hand.
    """
    if record.verdict is not Verdict.SAT:
        return None
    witness = folder.witness(record)
    entry = _entry(record, root) if root is not None else None
    check = folder.check(record.instance)
    stored = check if check and not recheck and _is_of(check, record, witness) else None
    if stored and (stored.checked_with == versions() or not _at_hand(entry, record)):
        return stored
    if entry is None:
        raise BadInput(
            f"{folder.path}: the witness of {record.instance} must be replayed; "
            "give the instances with --benchmarks"
        )
    return check_entry(entry, record, witness)


def _entry(record: Record, root: Path) -> Entry:
    onnx, spec = (find_file(path) or path for path in (root / record.onnx, root / record.spec))
    return Entry(record.instance, record.category, onnx, spec, record.limits.wall_s)


def _is_of(check: WitnessCheck, record: Record, witness: bytes) -> bool:
    return (check.instance, check.witness_sha256, check.spec_sha256, check.onnx_sha256) == (
        record.instance,
        hashlib.sha256(witness).hexdigest(),
        record.spec_sha256,
        record.onnx_sha256,
    )


def _at_hand(entry: Entry | None, record: Record) -> bool:
    """Whether the files are there, the same as when the tool was run."""
    return entry is not None and all(
        path.is_file() and sha256(path) == known
        for path, known in ((entry.spec, record.spec_sha256), (entry.onnx, record.onnx_sha256))
    )

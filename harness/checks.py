"""The check that every sat needs: stored with the run, and good for exactly one witness."""

from __future__ import annotations

import hashlib
from pathlib import Path

from harness.catalogue import Entry
from harness.records import Record, Verdict, WitnessCheck
from harness.store import RunFolder
from racecar.errors import BadInput


def check_entry(entry: Entry, record: Record, witness: bytes) -> WitnessCheck:
    """Replay the witness of a record; BadInput if the instance is not the one that was run."""
    # Slow to import (onnxruntime), and needed for a witness only.
    from harness.replay import check_witness  # noqa: PLC0415
    from racecar.instance import load_instance  # noqa: PLC0415

    check = check_witness(load_instance(entry.spec), entry.spec, witness)
    if (check.spec_sha256, check.onnx_sha256) != (record.spec_sha256, record.onnx_sha256):
        raise BadInput(
            f"{entry.spec}: the instance, or its controller, is not the one that "
            f"{record.tool} was given; run it anew"
        )
    return check


def witness_check(
    folder: RunFolder, record: Record, root: Path | None, recheck: bool = False
) -> WitnessCheck | None:
    """Return the check of a record's witness; None if the record is not sat."""
    if record.verdict is not Verdict.SAT:
        return None
    witness = folder.witness(record)
    check = folder.check(record.instance)
    if check is not None and not recheck and _is_current(check, record, witness):
        return check
    if root is None:
        raise BadInput(
            f"{folder.path}: the witness of {record.instance} must be replayed; "
            "give the instances with --benchmarks"
        )
    onnx, spec = root / record.onnx, root / record.spec
    entry = Entry(record.instance, record.category, onnx, spec, record.limits.wall_s)
    return check_entry(entry, record, witness)


def _is_current(check: WitnessCheck, record: Record, witness: bytes) -> bool:
    return (check.instance, check.witness_sha256, check.spec_sha256, check.onnx_sha256) == (
        record.instance,
        hashlib.sha256(witness).hexdigest(),
        record.spec_sha256,
        record.onnx_sha256,
    )

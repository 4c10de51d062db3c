"""Turn run folders into claims: every sat with a check of exactly the witness that is there."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from harness.catalogue import Reference, find_file, is_query, load_references, sha256
from harness.checks import witness_check
from harness.records import Record, WitnessCheck
from harness.scoring import Claim
from harness.store import RunFolder
from racecar.errors import BadInput

if TYPE_CHECKING:
    from harness.submission.source import Submitted


@dataclass(frozen=True)
class Evidence:
    """What the scoring needs, and what explains it.

    checked: the records, each with the check of its witness, in the order of the claims; notes:
    what a reader should know, one line each.
    """

    claims: list[Claim]
    references: dict[str, Reference]
    notes: list[str]
    checked: list[tuple[Record, WitnessCheck | None]]


def gather(
    folders: Sequence[RunFolder | Submitted], root: Path | None, recheck: bool = False
) -> Evidence:
    """Read runs, or submissions, and reference results.

    recheck: replay every witness again. A witness that has no check, or was changed since, is
    replayed in any case, from the instances in ``root``. BadInput if a tool has two results
    for an instance, or if runs were made on different versions of it.
    """
    claims: dict[tuple[str, str], Claim] = {}
    checked: list[tuple[Record, WitnessCheck | None]] = []
    versions: dict[str, Record] = {}
    for folder in folders:
        for record, check in _results(folder, root, recheck):
            key = (record.tool, record.instance)
            if key in claims:
                raise BadInput(
                    f"{folder.path}: tool {record.tool} already has a result for "
                    f"{record.instance}; leave one run out, or run it under another --name"
                )
            other = versions.setdefault(record.instance, record)
            if _identity(other) != _identity(record) and not _same_query(other, record, root):
                raise BadInput(
                    f"{folder.path}: {record.instance} is another version of the instance than "
                    "in the runs before; runs can be compared on the same files only"
                )
            claims[key] = claim_of(record, check)
            checked.append((record, check))
    if not claims:
        raise BadInput("there is no result in " + ", ".join(str(f.path) for f in folders))
    references, notes = _references(versions, root)
    notes += _unequal_limits(claims.values())
    return Evidence(list(claims.values()), references, notes, checked)


def _results(
    folder: RunFolder | Submitted, root: Path | None, recheck: bool
) -> Iterable[tuple[Record, WitnessCheck | None]]:
    if not isinstance(folder, RunFolder):
        yield from folder.checked
        return
    for record in folder.records():
        yield record, witness_check(folder, record, root, recheck)


def _identity(record: Record) -> tuple[str, ...]:
    return record.category, record.spec_sha256, record.onnx_sha256


def _same_query(a: Record, b: Record, root: Path | None) -> bool:
    """Whether both ran one query of the benchmarks, each in another version of VNN-LIB."""
    specs = Path(a.spec), Path(b.spec)
    if root is None or not all(map(is_query, specs)):
        return False
    folders = {os.path.normpath(root / spec.parent.parent) for spec in specs}
    same = len(folders) == 1 and (a.category, a.onnx_sha256) == (b.category, b.onnx_sha256)
    return same and all(_is_current(record, root) for record in (a, b))


def _is_current(record: Record, root: Path) -> bool:
    """Whether the benchmarks hold the specification that a record names."""
    spec = find_file(root / record.spec)
    return spec is not None and sha256(spec) == record.spec_sha256


def claim_of(record: Record, check: WitnessCheck | None) -> Claim:
    """Return what a record, and the check of its witness, claim."""
    return Claim(
        tool=record.tool,
        category=record.category,
        instance=record.instance,
        verdict=record.verdict,
        run_time=record.run_time,
        timeout=record.limits.wall_s,
        witness=check.outcome if check else None,
    )


def _references(
    versions: Mapping[str, Record], root: Path | None
) -> tuple[dict[str, Reference], list[str]]:
    """Return the reference results of exactly the instances that were run."""
    if root is None:
        return {}, ["no benchmarks folder, so there are no reference results to compare with"]
    references, changed = {}, []
    everything = load_references(root)
    for instance, record in versions.items():
        reference = everything.get(instance)
        if reference is None:
            continue
        if _is_current(record, root):
            references[instance] = reference
        else:
            changed.append(instance)
    if not changed:
        return references, []
    return references, [
        f"{len(changed)} instances ({changed[0]}, ...) are another version than {root} holds; "
        "their reference results are not used"
    ]


def _unequal_limits(claims: Iterable[Claim]) -> list[str]:
    """Note the categories in which the tools did not have the same time."""
    limits: dict[str, float] = {}
    unequal: dict[str, None] = {}
    for claim in claims:
        if limits.setdefault(claim.instance, claim.timeout) != claim.timeout:
            unequal[claim.category] = None
    return [f"{category}: the tools were given different time limits" for category in unequal]

"""Pack runs into a submission."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from harness.catalogue import Reference
from harness.evidence import claim_of
from harness.machine import package_version
from harness.records import Data, Record, RunInfo, WitnessCheck
from harness.scoring import score
from harness.store import RunFolder
from harness.submission.archive import write_archive
from harness.submission.model import About, Packed, Results, Submission
from racecar.controller import write_whole
from racecar.errors import BadInput


def pack(
    folders: Sequence[RunFolder],
    checked: Sequence[Sequence[tuple[Record, WitnessCheck | None]]],
    about: About,
    output: Path,
) -> Submission:
    """Write a submission, whole or not at all; checked: of each run, records and their checks.

    BadInput if the runs are not of the tool that ``about`` names, or say different things of one
    instance.
    """
    _check(folders, checked, about)
    small: dict[str, bytes] = {}
    witnesses: dict[str, tuple[RunFolder, Record]] = {}
    for number, (folder, results) in enumerate(zip(folders, checked, strict=True)):
        checks = [check for _, check in results if check is not None]
        small[f"runs/{number}/run.json"] = _json(folder.info())
        small[f"runs/{number}/records.jsonl"] = _lines([record for record, _ in results])
        small[f"runs/{number}/checks.jsonl"] = _lines(checks)
        for record, check in results:
            if check is not None:
                witnesses[f"witnesses/{check.witness_sha256}"] = (folder, record)
    small["results.json"] = _json(results_of([pair for results in checked for pair in results]))
    listed = [Packed(path=p, size=len(c), sha256=_sha256(c)) for p, c in small.items()]
    for path, (folder, record) in witnesses.items():
        content = folder.witness(record)
        listed.append(Packed(path=path, size=len(content), sha256=_sha256(content)))
    submission = Submission(
        about=about,
        harness_version=package_version("closedlap"),
        runs=len(folders),
        files=tuple(sorted(listed, key=lambda file: file.path)),
    )
    small["submission.json"] = _json(submission)

    def contents() -> Iterator[tuple[str, bytes]]:
        for path in sorted([*small, *witnesses]):
            yield (
                path,
                small[path] if path in small else witnesses[path][0].witness(witnesses[path][1]),
            )

    archive = io.BytesIO()
    write_archive(contents(), archive)
    write_whole(output, archive.getvalue())
    return submission


def results_of(
    checked: Sequence[tuple[Record, WitnessCheck | None]],
    references: dict[str, Reference] | None = None,
) -> Results:
    """Return the score of some results alone."""
    scores = score([claim_of(record, check) for record, check in checked], references or {})
    return Results(rows=scores.rows)


def _check(
    folders: Sequence[RunFolder],
    checked: Sequence[Sequence[tuple[Record, WitnessCheck | None]]],
    about: About,
) -> None:
    seen: dict[str, RunFolder] = {}
    for folder, results in zip(folders, checked, strict=True):
        _check_tool(folder, folder.info(), about)
        if not results:
            raise BadInput(f"{folder.path}: it has no results; leave it out")
        for record, _ in results:
            other = seen.setdefault(record.instance, folder)
            if other is not folder:
                raise BadInput(
                    f"{folder.path}: {other.path} has a result for {record.instance}, too; "
                    "leave one run out"
                )


def _check_tool(folder: RunFolder, info: RunInfo, about: About) -> None:
    for what, there, said in (
        ("tool", info.tool.name, about.tool),
        ("version", info.tool.version, about.version),
    ):
        if there is not None and there != said:
            raise BadInput(f"{folder.path}: it is a run of {what} {there}, not {said}")


def _lines(data: Sequence[Data]) -> bytes:
    return "".join(f"{item.model_dump_json()}\n" for item in data).encode()


def _json(data: Data) -> bytes:
    return (data.model_dump_json(indent=2) + "\n").encode()


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()

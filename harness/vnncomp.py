"""A run in the folders that VNN-COMP 2026 publishes results in, for its own scoring.

    DIR/TOOL/2026_closedlap_CATEGORY/
        results.csv                             six columns, no header
        NET_PROP.counterexample.gz              what followed ``sat``
        NET_PROP.counterexample.check.json      this harness's check of it, in VNN-COMP's form
        vnnlib_version.txt                      which version of VNN-LIB the specifications have

The scoring reads benchmarks from folders laid out as by ``generator export --layout vnncomp``.
It takes a check file only from its own checker; ours are there for people, and it replaces them.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import json
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path, PurePosixPath

from harness.catalogue import ZIPPED, is_query
from harness.records import Record, Verdict, WitnessCheck, WitnessOutcome
from harness.store import RunFolder
from racecar.errors import BadInput

YEAR = "2026"
_PREFIX = "closedlap_"
_VERSION = re.compile(r"\d+\.\d+")
#: The only text of a 1.0 witness on which VNN-COMP's reader does not stop the whole scoring.
_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_READABLE_1 = re.compile(rb"\(\s*(?:\([XY]_\d+ +" + _NUMBER + rb"\)\s*)+\)")
_RESULTS = {
    WitnessOutcome.CORRECT: "correct",
    WitnessOutcome.CORRECT_WITH_TOLERANCE: "correct_up_to_tolerance",
    WitnessOutcome.MISSING: "no_ce",
    WitnessOutcome.MALFORMED: "malformed_ce",
    WitnessOutcome.UNSUPPORTED: "unsupported",
}
_CLASSES = {
    "correct_up_to_tolerance": "correct_with_tolerance",
    "no_ce": "missing",
    "malformed_ce": "malformed",
    "spec_not_violated": "incorrect",
}


@dataclass(frozen=True)
class Exported:
    """One folder that was written: how many rows and witnesses; and what a reader should know."""

    folder: Path
    rows: int
    witnesses: int
    notes: tuple[str, ...] = ()


@dataclass
class _Part:
    """The files of one category, by name."""

    files: dict[str, bytes] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    rows: int = 0
    witnesses: int = 0


def export_vnncomp(folder: RunFolder, out: Path) -> list[Exported]:
    """Write the VNN-LIB results of a run; all folders or none.

    Raises BadInput if the run has none, if one of the folders exists already, or if a category
    was run in both versions of VNN-LIB.
    """
    records = folder.records()
    chosen = [record for record in records if is_query(Path(record.spec))]
    if not chosen:
        raise BadInput(
            f"{folder.path}: it has no result on a VNN-LIB instance, and VNN-COMP's scoring "
            "knows no others; --layout csv writes all results"
        )
    parts: dict[Path, _Part] = {}
    for (tool, category), group in groupby(chosen, lambda r: (r.tool, r.category)):
        target = out / tool / f"{YEAR}_{benchmark_name(category)}"
        if target.exists():
            raise BadInput(f"{target}: it exists; give another folder with -o")
        parts[target] = _part(folder, list(group))
    for target, part in parts.items():
        _write_folder(target, part.files)
    left_out = len(records) - len(chosen)
    if left_out:
        last = parts[list(parts)[-1]]
        last.notes.append(f"left out, since they are not about VNN-LIB files: {left_out}")
    return [
        Exported(target, part.rows, part.witnesses, tuple(part.notes))
        for target, part in parts.items()
    ]


def benchmark_name(category: str) -> str:
    """Return what a category is called among other people's benchmarks."""
    return category if category.startswith(_PREFIX) else _PREFIX + category


def _part(folder: RunFolder, records: Sequence[Record]) -> _Part:
    """Return the files of one tool's results in one category."""
    benchmark = benchmark_name(records[0].category)
    versions = {_version(record) for record in records}
    if len(versions) > 1:
        raise BadInput(
            f"{folder.path}: {records[0].category} was run in VNN-LIB {' and '.join(versions)}; "
            "VNN-COMP takes one version a benchmark, so make one run of each"
        )
    version = versions.pop()
    part, text = _Part(), io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for record in records:
        row = _row(record, benchmark, version)
        writer.writerow(row)
        part.rows += 1
        if record.verdict is Verdict.SAT:
            _add_witness(part, folder, record, row, version)
    part.files["results.csv"] = text.getvalue().encode()
    part.files["vnnlib_version.txt"] = f"{benchmark}  {version}\n".encode()
    return part


def _version(record: Record) -> str:
    """Return the VNN-LIB version of an instance: a folder on the way to it is named so."""
    for name in reversed(PurePosixPath(record.spec).parent.parts):
        if _VERSION.fullmatch(name):
            return name
    raise BadInput(
        f"{record.spec}: no folder on its path says which version of VNN-LIB it is (1.0 or 2.0)"
    )


def _row(record: Record, benchmark: str, version: str) -> list[str]:
    """Return the six columns; the paths are those of VNN-COMP's own repository of benchmarks."""
    root = PurePosixPath(f"vnncomp{YEAR}_benchmarks/benchmarks", benchmark, version)
    return [
        benchmark,
        str(root / "onnx" / PurePosixPath(record.onnx).name.removesuffix(ZIPPED)),
        str(root / "vnnlib" / PurePosixPath(record.spec).name.removesuffix(ZIPPED)),
        f"{record.prepare_time:.3f}",
        record.result,
        f"{record.run_time:.3f}",
    ]


def _add_witness(
    part: _Part, folder: RunFolder, record: Record, row: list[str], version: str
) -> None:
    name = f"{PurePosixPath(row[1]).stem}_{PurePosixPath(row[2]).stem}.counterexample"
    witness, check = folder.witness(record), folder.check(record.instance)
    content: bytes | None = None
    if not witness.strip():
        part.notes.append(f"{record.instance}: there is no witness")
    elif version == "1.0" and not _READABLE_1.fullmatch(witness.strip()):
        # A missing witness costs what a malformed one does, and stops nothing.
        part.notes.append(
            f"{record.instance}: the witness is left out; VNN-COMP's reader would end at it"
        )
    else:
        content = gzip.compress(witness, mtime=0)
        part.files[f"{name}.gz"] = content
        part.witnesses += 1
    if check is not None:
        data = check_data(check, row, version, f"{name}.gz", content)
        part.files[f"{name}.check.json"] = (
            json.dumps(data, indent=2, sort_keys=True) + "\n"
        ).encode()


def check_data(
    check: WitnessCheck, row: Sequence[str], version: str, name: str, content: bytes | None
) -> Mapping[str, object]:
    """Return a check as VNN-COMP writes it, signed as ours.

    row: of results.csv; name, content: of the witness's file, None if there is none.
    """
    outcome = check.outcome if content is not None else WitnessOutcome.MISSING
    result = _RESULTS.get(outcome, "spec_not_violated")
    scored = [*row[:4], "violated", row[5]]
    identity = json.dumps(scored, sort_keys=True, separators=(",", ":"))
    return {
        "schema_version": 1,
        "checker_version": f"closedlap-{check.checked_with.get('closedlap', 'unknown')}",
        "dependency_versions": dict(check.checked_with),
        "provider": "CPUExecutionProvider",
        "benchmark": {
            "category": f"{YEAR}_{row[0]}",
            "version": version,
            "network_field": row[1],
            "property_field": row[2],
        },
        "witness_path": name,
        "witness_sha256": hashlib.sha256(content).hexdigest() if content is not None else None,
        "results_row_identity": hashlib.sha256(identity.encode()).hexdigest(),
        "classification": _CLASSES.get(result, result),
        "establishes_sat": outcome.establishes_sat,
        "score_credit": outcome.credited,
        "result": result,
        "rationale": check.message,
    }


def _write_folder(target: Path, files: Mapping[str, bytes]) -> None:
    """Write a folder so that it is complete or absent."""
    target.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        for name, content in files.items():
            (part / name).write_bytes(content)
        part.chmod(0o755)
        part.rename(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise

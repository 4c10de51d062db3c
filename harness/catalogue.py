"""The benchmarks folder: categories, their instances, and the reference results.

- CATEGORY/instances.csv: onnx, spec, timeout; no header; paths relative to CATEGORY; a file
  that is there only with .gz after its name is meant, too
- CATEGORY/reference.csv: a header with instance, verdict, margin_lower, margin_upper, ...
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import math
import os
import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import harness
from harness.records import Verdict
from racecar.errors import BadInput

INSTANCES, REFERENCE = "instances.csv", "reference.csv"
VNNLIB, ZIPPED = ".vnnlib", ".gz"
#: Timeout, in seconds, of an instance that stands in no instances.csv.
DEFAULT_TIMEOUT_S = 60.0
#: How every gzip file begins.
_GZIP = b"\x1f\x8b"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,199}")


@dataclass(frozen=True)
class Entry:
    """One instance to run: its files and its time limit in seconds.

    spec: JSON for a closed loop, VNN-LIB (.vnnlib) for a network. VNN-LIB files and their
    networks may be gzipped.
    """

    id: str
    category: str
    onnx: Path
    spec: Path
    timeout: float


@dataclass(frozen=True)
class Reference:
    """A reference result: a verdict, and a bracket on the true margin (m) where known.

    margin_lower: proved; margin_upper: of the best replayed witness.
    """

    verdict: Verdict
    margin_lower: float | None = None
    margin_upper: float | None = None

    @property
    def proves_sat(self) -> bool:
        """Whether it is sat, with a witness that reaches the unsafe set."""
        upper = self.margin_upper
        return self.verdict is Verdict.SAT and upper is not None and upper <= 0


def find_root(option: Path | None) -> Path | None:
    """Return the benchmarks folder: the one given, ./benchmarks, or the source checkout's.

    None if there is none; BadInput if the one given is no folder.
    """
    if option is not None:
        if not option.is_dir():
            raise BadInput(f"{option}: there is no benchmarks folder")
        return option.resolve()
    beside = Path(harness.__file__).resolve().parents[1] / "benchmarks"
    for folder in (Path("benchmarks"), beside):
        if folder.is_dir():
            return folder.resolve()
    return None


def require_root(option: Path | None) -> Path:
    """Return the benchmarks folder; BadInput if there is none."""
    root = find_root(option)
    if root is None:
        raise BadInput(
            "no benchmarks folder: neither ./benchmarks nor one beside the harness is there; "
            "give one with --benchmarks DIR"
        )
    return root


def category_names(root: Path) -> list[str]:
    """Return the names of the categories."""
    return sorted(path.parent.name for path in root.glob(f"*/{INSTANCES}"))


def load_category(root: Path, name: str) -> list[Entry]:
    """Return the instances of a category in the order of its file; BadInput if it is broken."""
    known = category_names(root)
    if name not in known:
        there = f"choose one of {', '.join(known)}" if known else "it holds no category"
        raise BadInput(f"category {name!r} is unknown in {root}; {there}")
    folder = root / name
    file = folder / INSTANCES
    entries = []
    for line, row in _rows(file):
        where = f"{file}, line {line}"
        if len(row) != 3:
            raise BadInput(f"{where}: {len(row)} columns; it must have onnx, spec, timeout")
        onnx, spec = (_there(folder / part.strip(), where) for part in row[:2])
        id = instance_id(spec)
        if not _NAME.fullmatch(id):
            raise BadInput(f"{where}: {id!r} does not serve as an instance's ID")
        entries.append(Entry(id, name, onnx, spec, _timeout(row[2], where)))
    return entries


def instance_id(spec: Path) -> str:
    """Return the ID of the instance that a file in a category specifies: its name, bare."""
    return spec.with_suffix("").stem if spec.suffix == ZIPPED else spec.stem


def is_query(spec: Path) -> bool:
    """Whether a specification is VNN-LIB, by its name."""
    return [part for part in spec.suffixes if part != ZIPPED][-1:] == [VNNLIB]


def _there(path: Path, where: str) -> Path:
    path = Path(os.path.normpath(path))
    found = find_file(path)
    if found is None:
        raise BadInput(f"{where}: there is no file {path}")
    return found


def find_file(path: Path) -> Path | None:
    """Return a file, or the same with or without .gz after its name; None if neither is there."""
    others = (path.with_name(path.name + ZIPPED), path.with_name(plain_name(path.name)))
    return next((found for found in (path, *others) if found.is_file()), None)


def plain_name(name: str) -> str:
    """Return a name or path without the .gz that it may end in."""
    return name.removesuffix(ZIPPED)


def _timeout(text: str, where: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0):
        raise BadInput(f"{where}: timeout {text!r} is not a positive number of seconds")
    return seconds


def load_file(path: Path) -> Entry:
    """Return the instance of a JSON file that need not stand in a category."""
    if is_query(path):
        raise BadInput(
            f"{path}: a VNN-LIB file does not name its network; give one that a category's "
            f"{INSTANCES} lists, or the same in the other version of VNN-LIB"
        )
    # Slow to import, and needed for loose files only.
    from racecar.instance import (  # noqa: PLC0415
        controller_path,
        load_instance,
        load_instance_controller,
    )

    instance = load_instance(path)
    load_instance_controller(instance, path)
    onnx, spec = controller_path(instance, path).resolve(), path.resolve()
    return Entry(instance.id, instance.category, onnx, spec, DEFAULT_TIMEOUT_S)


def select(root: Path | None, categories: Sequence[str], instances: Sequence[str]) -> list[Entry]:
    """Return the instances of the categories and those named, each once.

    categories, instances: names of categories, and instance files or IDs of instances in the
    benchmarks; with neither, everything there is. root: may be None where only files are
    named. BadInput says what cannot be found, or that two instances have one ID.
    """
    entries: list[Entry] = []
    names: Sequence[str] = categories
    if root is not None:
        names = categories or ([] if instances else category_names(root))
        if not names and not instances:
            raise BadInput(f"{root}: it holds no category; give another with --benchmarks DIR")
        entries += [entry for name in dict.fromkeys(names) for entry in load_category(root, name)]
    elif categories or not instances:
        raise BadInput("no benchmarks folder; give one with --benchmarks DIR")
    entries += _named(root, instances)
    if not entries:
        raise BadInput(f"{root}: there is no instance to run in {', '.join(names)}")
    unique: dict[str, Entry] = {}
    for entry in entries:
        other = unique.setdefault(entry.id, entry)
        if other.spec != entry.spec:
            raise BadInput(f"{other.spec} and {entry.spec} are instances with the same ID")
    return list(unique.values())


def _named(root: Path | None, instances: Sequence[str]) -> Iterable[Entry]:
    known: list[Entry] | None = None
    for text in instances:
        path = Path(text).resolve()
        inside = root is not None and (path.is_relative_to(root) or is_query(path))
        if path.is_file() and not inside:
            yield load_file(path)
            continue
        if known is None:
            known = load_everything(root) if root else []
        entry = next((e for e in known if e.spec == path or e.id == text), None)
        entry = entry or _other_version(known, path)
        if entry is not None:
            yield entry
        elif path.is_file():
            yield load_file(path)
        else:
            where = f"nor an instance of {root}" if root else "and there is no benchmarks folder"
            raise BadInput(f"instance {text}: there is no such file, {where}")


def _other_version(known: Sequence[Entry], path: Path) -> Entry | None:
    """Return the instance that a VNN-LIB file asks in another version than the one listed.

    The versions lie side by side: vnnlib/CATEGORY/1.0/ID.vnnlib and vnnlib/CATEGORY/2.0/ID.vnnlib.
    """
    if not (is_query(path) and path.is_file()):
        return None
    same = (entry for entry in known if entry.id == instance_id(path) and is_query(entry.spec))
    return next((e for entry in same for e in in_all_versions(entry) if e.spec == path), None)


def in_all_versions(entry: Entry) -> list[Entry]:
    """Return an instance, and the same with its query in the other versions of VNN-LIB."""
    if not is_query(entry.spec):
        return [entry]
    found = sorted(entry.spec.parents[1].glob(f"*/{entry.id}{VNNLIB}*"))
    others = [path for path in found if path != entry.spec and instance_id(path) == entry.id]
    return [entry, *(replace(entry, spec=path) for path in others)]


def load_everything(root: Path) -> list[Entry]:
    """Return the instances of all categories."""
    return [entry for name in category_names(root) for entry in load_category(root, name)]


def relative(path: Path, root: Path | None) -> str:
    """Return a path relative to the benchmarks folder, with forward slashes.

    A file that lies neither below the folder nor below its parent is named by its full path.
    """
    if root is None or not path.is_relative_to(root.parent):
        return path.as_posix()
    return Path(os.path.relpath(path, root)).as_posix()


def sha256(path: Path) -> str:
    """Return the sha256 of a file, of a gzipped one that of what it holds.

    So a result stays that of an instance whose files are packed, by whichever zlib. BadInput if
    the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            zipped = file.read(len(_GZIP)) == _GZIP
        with gzip.open(path) if zipped else path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, EOFError, zlib.error) as error:
        why = getattr(error, "strerror", None) or error
        raise BadInput(f"{path}: cannot be read ({why})") from None


def load_references(root: Path) -> dict[str, Reference]:
    """Return the reference results of all categories, by instance ID."""
    found: dict[str, Reference] = {}
    for name in category_names(root):
        file = root / name / REFERENCE
        if not file.is_file():
            continue
        rows = iter(_rows(file))
        _, header = next(rows, (1, []))
        if not {"instance", "verdict", "margin_lower", "margin_upper"} <= set(header):
            raise BadInput(
                f"{file}, line 1: the header must name "
                "instance, verdict, margin_lower and margin_upper"
            )
        for line, row in rows:
            where = f"{file}, line {line}"
            if len(row) != len(header):
                raise BadInput(f"{where}: {len(row)} columns, but the header has {len(header)}")
            data = dict(zip(header, row, strict=True))
            found[data["instance"]] = _reference(data, where)
    return found


def _reference(data: dict[str, str], where: str) -> Reference:
    allowed = (Verdict.SAT, Verdict.UNSAT, Verdict.UNKNOWN)
    if data["verdict"] not in allowed:
        raise BadInput(f"{where}: verdict is {data['verdict']!r}; it must be sat, unsat or unknown")
    try:
        lower, upper = (
            float(data[column]) if data[column].strip() else None
            for column in ("margin_lower", "margin_upper")
        )
    except ValueError:
        raise BadInput(f"{where}: a margin is not a number") from None
    return Reference(Verdict(data["verdict"]), lower, upper)


def _rows(file: Path) -> Iterable[tuple[int, list[str]]]:
    """Yield the line number and the fields of every line that is not blank."""
    try:
        with file.open(encoding="utf-8", newline="") as text:
            reader = csv.reader(text, strict=True)
            for row in reader:
                if any(field.strip() for field in row):
                    yield reader.line_num, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadInput(f"{file}: cannot be read ({error})") from None

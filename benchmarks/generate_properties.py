"""Choose a competition set from the committed instances: python generate_properties.py SEED [OUT].

Writes OUT/CATEGORY/instances.csv (VNN-COMP's columns: onnx, spec, timeout; paths relative to
CATEGORY), OUT/CATEGORY/reference.csv where there is one, and OUT/grades.csv, which says for every
chosen instance its grade and what that rests on. OUT is `competition` beside the folder of this
file unless given. The same seed and the same dataset give the same files. Timeouts sum to less than
six hours; every category gets as large a part of that as any other, if it can use it.

Grades, within a category:
  easy    the reference verifier decides it, in no more than the median time of those it decides
  medium  it decides it, in more
  open    it does not
An instance that follows from another one's result takes that one's time.
An instance without a row in reference.csv is graded by its structure: thirds by the product of
rays, steps, width of the start set, noise and missing rays (JSON), or by the length of the
specification (VNN-LIB). Needs nothing but Python.
"""

from __future__ import annotations

import bisect
import csv
import gzip
import hashlib
import json
import os
import statistics
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

HERE = Path(__file__).resolve().parent
#: The timeouts of a set sum to less than so many seconds.
BUDGET = 6 * 3600
GRADES = ("easy", "medium", "open")
USAGE = "usage: python generate_properties.py SEED [OUT]  (SEED: a whole number)"


@dataclass(frozen=True)
class Instance:
    """A row of instances.csv; by: what the grade rests on."""

    id: str
    category: str
    onnx: Path
    spec: Path
    timeout: int
    grade: str = ""
    by: str = ""


@dataclass(frozen=True)
class Result:
    """A row of reference.csv; seconds: of the search; source: the instance that was searched."""

    instance: str
    verdict: str
    seconds: float | None
    source: str


def main(arguments: list[str]) -> int:
    """Write the set of a seed; return the exit status."""
    if len(arguments) not in (1, 2) or not arguments[0].isdecimal():
        print(USAGE, file=sys.stderr)
        return 2
    out = Path(arguments[1]) if len(arguments) == 2 else HERE.parent / "competition"
    if out.resolve() == HERE:
        print(f"error: {out}: the dataset lies there; choose another folder", file=sys.stderr)
        return 2
    chosen = choose(load(HERE), int(arguments[0]))
    write(chosen, HERE, out)
    total = sum(instance.timeout for instance in chosen)
    print(f"{len(chosen)} instances, timeouts of {total} s in all, in {out}")
    return 0


def load(root: Path) -> dict[str, list[Instance]]:
    """Return the instances of all categories, graded, by category."""
    folders = [path.parent for path in sorted(root.glob("*/instances.csv"))]
    results = {folder.name: _results(folder / "reference.csv") for folder in folders}
    times = {row.instance: row.seconds for rows in results.values() for row in rows}
    return {folder.name: _graded(folder, results[folder.name], times) for folder in folders}


def choose(
    categories: dict[str, list[Instance]], seed: int, budget: int = BUDGET
) -> list[Instance]:
    """Return a choice by category and, in it, in the order of its instances.csv.

    Each category takes easy, medium and open instances in turn, in an order that the seed says:
    first up to its equal part of the budget, then, one after the other, what is left of it.
    """
    waiting = {name: _order(instances, seed) for name, instances in categories.items()}
    chosen: set[str] = set()
    left = budget - 1
    part = left // max(len(waiting), 1)
    for name, instances in waiting.items():
        for instance in _fitting(instances, part):
            chosen.add(instance.id)
            left -= instance.timeout
        waiting[name] = [instance for instance in instances if instance.id not in chosen]
    while True:
        turn = [next(_fitting(instances, left), None) for instances in waiting.values()]
        found = [instance for instance in turn if instance is not None]
        if not found:
            break
        for instance in found:
            if instance.timeout <= left:
                chosen.add(instance.id)
                left -= instance.timeout
            waiting[instance.category].remove(instance)
    return [x for instances in categories.values() for x in instances if x.id in chosen]


def _fitting(instances: list[Instance], seconds: int) -> Iterator[Instance]:
    """Yield instances, in order, whose timeouts fit into so many seconds together."""
    for instance in instances:
        if instance.timeout <= seconds:
            seconds -= instance.timeout
            yield instance


def write(chosen: list[Instance], root: Path, out: Path) -> None:
    """Write the tables of a set, and of the reference results the rows about it."""
    for name in sorted({instance.category for instance in chosen}):
        folder, here = out / name, [x for x in chosen if x.category == name]
        rows = [
            (os.path.relpath(x.onnx, folder), os.path.relpath(x.spec, folder), x.timeout)
            for x in here
        ]
        _write(folder / "instances.csv", [[str(x).replace(os.sep, "/") for x in r] for r in rows])
        reference = root / name / "reference.csv"
        if reference.is_file():
            ids = {instance.id for instance in here}
            head, *results = _read(reference)
            at = head.index("instance")
            _write(folder / "reference.csv", [head, *(r for r in results if r[at] in ids)])
        else:
            (folder / "reference.csv").unlink(missing_ok=True)
    rest = [[x.category, x.id, x.grade, x.by] for x in chosen]
    _write(out / "grades.csv", [["category", "instance", "grade", "by"], *rest])


def _order(instances: list[Instance], seed: int) -> list[Instance]:
    """Return the grades' instances in turn, each grade's in the order that the seed says."""

    def key(instance: Instance) -> str:
        return hashlib.sha256(f"{seed}/{instance.id}".encode()).hexdigest()

    turns = []
    for number, grade in enumerate(GRADES):
        drawn = sorted((x for x in instances if x.grade == grade), key=key)
        turns += [((turn, number), instance) for turn, instance in enumerate(drawn)]
    return [instance for _, instance in sorted(turns, key=lambda turn: turn[0])]


def _graded(folder: Path, results: list[Result], times: dict[str, float | None]) -> list[Instance]:
    """Return the instances of a category with their grades; times (s): of all results."""
    instances = []
    for onnx, spec, timeout in _read(folder / "instances.csv"):
        path = folder / spec
        instances.append(Instance(path.stem, folder.name, folder / onnx, path, int(timeout)))
    known = {row.instance: row for row in results}
    taken = {
        row.instance: row.seconds if row.seconds is not None else times.get(row.source) or 0.0
        for row in results
        if row.verdict != "unknown"
    }
    median = statistics.median(taken.values()) if taken else 0.0
    thirds = _thirds([instance for instance in instances if instance.id not in known])
    graded = []
    for instance in instances:
        by = "reference" if instance.id in known else "structure"
        if instance.id in taken:
            grade = "easy" if taken[instance.id] <= median else "medium"
        else:
            grade = thirds.get(instance.id, "open")
        graded.append(replace(instance, grade=grade, by=by))
    return graded


def _results(table: Path) -> list[Result]:
    """Return the rows of a reference.csv; none if there is no table."""
    if not table.is_file():
        return []
    head, *rows = _read(table)
    found = []
    for row in rows:
        data = dict(zip(head, row, strict=True))
        seconds = float(data["time_s"]) if data.get("time_s") else None
        found.append(Result(data["instance"], data["verdict"], seconds, data.get("source", "")))
    return found


def _thirds(instances: list[Instance]) -> dict[str, str]:
    """Return grades by the structure of the questions; equally large ones get the same."""
    sizes = {instance.id: _size(instance.spec) for instance in instances}
    order = sorted(sizes.values())
    return {
        name: GRADES[bisect.bisect_left(order, size) * len(GRADES) // len(order)]
        for name, size in sizes.items()
    }


def _size(spec: Path) -> float:
    """Return how large a question is, in a measure that its category shares."""
    if spec.suffix != ".json":
        packed = spec.with_name(f"{spec.name}.gz")
        return float(
            len(spec.read_bytes() if spec.is_file() else gzip.decompress(packed.read_bytes()))
        )
    data = json.loads(spec.read_bytes())
    disturbance = data.get("disturbance") or {}
    size = data["plant"]["lidar"]["rays"] * data["steps"]
    for low, high in data["initial_set"].values():
        size *= 1 + round(1000 * (high - low), 6)
    return size * (1 + 1000 * disturbance.get("noise", 0)) * (1 + disturbance.get("missing", 0))


def _read(table: Path) -> list[list[str]]:
    with table.open(encoding="utf-8", newline="") as file:
        return [row for row in csv.reader(file) if row]


def _write(table: Path, rows: list[list[str]]) -> None:
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

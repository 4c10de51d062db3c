"""What the files of a dataset say about it: instances, sizes, reference results."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from generator import controllers_table
from generator.instances import ControllerFile
from generator.piece import FOLDER
from generator.reference.rows import REFERENCE, Row, read_rows
from racecar.errors import BadInput
from racecar.instance import read_text

DECIDED = ("sat", "unsat")


@dataclass(frozen=True)
class Known:
    """A reference result; lower, upper: bracket on the margin (m); seconds: of the verifier."""

    verdict: str
    lower: float | None
    upper: float | None
    seconds: float | None

    @property
    def decided(self) -> bool:
        """Whether it is sat or unsat."""
        return self.verdict in DECIDED


@dataclass(frozen=True)
class Asked:
    """An instance; width: of the start range in s (m), nan where it has none."""

    id: str
    controller: str
    timeout: int
    width: float
    known: Known | None


@dataclass(frozen=True)
class CategoryFacts:
    """A category; size: of its files, specifications and networks (bytes)."""

    name: str
    instances: tuple[Asked, ...]
    size: int

    @cached_property
    def results(self) -> list[Known]:
        """The reference results there are."""
        return [asked.known for asked in self.instances if asked.known is not None]

    def count(self, *verdicts: str) -> int:
        """Return how many instances have one of these reference verdicts."""
        return sum(known.verdict in verdicts for known in self.results)

    @property
    def open(self) -> int:
        """How many instances are not decided, those without a result included."""
        return len(self.instances) - self.count(*DECIDED)


@dataclass(frozen=True)
class Dataset:
    """Everything that the card tells.

    table: a row for each of the controllers; networks: what they take with their records (bytes).
    """

    controllers: tuple[ControllerFile, ...]
    table: tuple[controllers_table.Row, ...]
    categories: tuple[CategoryFacts, ...]
    networks: int

    @property
    def size(self) -> int:
        """Of all categories and the controllers, bytes."""
        return self.networks + sum(category.size for category in self.categories)

    def category(self, name: str) -> CategoryFacts | None:
        """Return a category; None if there is none of this name."""
        return next((c for c in self.categories if c.name == name), None)


def read_dataset(root: Path, order: Sequence[str]) -> Dataset:
    """Read what is emitted under a root; order: names of categories, those first.

    Raises BadInput if nothing is emitted there, or a table is broken.
    """
    names = {path.parent.name for path in (root / FOLDER).glob("*/instances.csv")}
    if not names:
        raise BadInput(f"{root / FOLDER}: no category is there; run `generator emit` first")
    published = controllers_table.load_all(root)
    table = tuple(controllers_table.read_table(root, published))
    listed = [name for name in order if name in names] + sorted(names - set(order))
    categories = tuple(_category(root, name) for name in listed)
    networks = _bytes(path for path in (root / "onnx").iterdir() if path.is_file())
    files = tuple(file for file, _ in published)
    return Dataset(files, table, categories, networks)


def _category(root: Path, name: str) -> CategoryFacts:
    folder = root / FOLDER / name
    results = {id: _known(row) for id, row in read_rows(folder).items()}
    asked = []
    table = folder / "instances.csv"
    for row in csv.reader(read_text(table).decode().splitlines()):
        if len(row) != 3 or not row[2].isdecimal():
            raise BadInput(f"{table}: {','.join(row)!r} is not onnx, spec, timeout; emit it again")
        id = PurePosixPath(row[1]).stem
        width = _width(folder / row[1])
        controller = id.partition(f".{name}.")[0]
        asked.append(Asked(id, controller, int(row[2]), width, results.get(id)))
    strange = sorted(set(results) - {instance.id for instance in asked})
    if strange:
        raise BadInput(
            f"{folder / REFERENCE}: {strange[0]} is no instance of {name}; "
            "run `generator reference` again"
        )
    folders = (folder, root / "vnnlib" / name, root / "onnx" / name)
    return CategoryFacts(name, tuple(asked), _bytes(p for f in folders for p in _emitted(f)))


def _known(row: Row) -> Known:
    texts = row.margin_lower, row.margin_upper, row.time_s
    lower, upper, seconds = (float(text) if text else None for text in texts)
    return Known(row.verdict, lower, upper, seconds)


def _width(spec: Path) -> float:
    if spec.suffix != ".json":
        return math.nan
    low, high = json.loads(read_text(spec))["initial_set"]["s"]
    return round(high - low, 9)


def _emitted(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder but the reference results."""
    for path in folder.rglob("*"):
        if path.is_file() and not path.relative_to(folder).parts[0].startswith("reference"):
            yield path


def _bytes(paths: Iterable[Path]) -> int:
    return sum(path.stat().st_size for path in paths)

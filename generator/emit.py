"""Emitting the instance sets: the same controllers give the same files, byte for byte."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from generator import hdf5
from generator.categories import CATEGORIES, Category
from generator.hdf5 import Dataset, Group
from generator.hybrid.json_form import automaton_schema
from generator.instances import ControllerFile
from generator.openloop.part import NETWORKS, SPECS
from generator.partition import Partition
from generator.piece import FOLDER, Piece, Row, make_piece
from generator.published import load_published, published_names
from generator.tree import TRACES, Emitted, Tree, format_json
from racecar.instance import instance_schema

SCHEMA, MANIFEST = f"{FOLDER}/instance.schema.json", f"{FOLDER}/manifest.json"
AUTOMATON_SCHEMA = f"{FOLDER}/automaton.schema.json"


def load_controllers(root: Path) -> list[ControllerFile]:
    """Return the controllers in ROOT/onnx that have a training record, by name.

    Raises BadInput if there is none, or if a record is not the one of its controller.
    """
    return [load_published(root, name)[0] for name in published_names(root)]


def build(
    root: Path,
    categories: Sequence[Category],
    controllers: Sequence[ControllerFile],
    report: Callable[[int, int], None] = lambda done, total: None,
    jobs: int = 1,
) -> Emitted:
    """Return every file of the categories, and the schemas.

    report(done, total) counts controllers, once for every category; jobs: processes that work at
    a time. The result does not depend on it.
    """
    tree: Tree = {
        SCHEMA: format_json(instance_schema()),
        AUTOMATON_SCHEMA: format_json(automaton_schema()),
    }
    wanted = [(category, file) for category in categories for file in controllers]
    pieces = {}
    for done, (key, piece) in enumerate(_pieces(root, wanted, jobs)):
        pieces[key] = piece
        report(done + 1, len(wanted))
    for category in categories:
        base = f"{FOLDER}/{category.name}"
        rows: list[Row] = []
        traces: dict[str, Dataset | Group] = {}
        for file in controllers:
            piece = pieces[category.name, file.name]
            tree |= piece.files
            rows += piece.rows
            if piece.traces is not None:
                traces[file.name] = piece.traces
        if not rows:
            continue
        tree[f"{base}/instances.csv"] = _csv(rows)
        if category.partitions:
            asked = [file for file in controllers if category.asks(file.controller.rays)]
            tree[f"{base}/partitions.h5"] = hdf5.to_bytes(_partitions(category, asked))
        if traces:
            group = Group("reference traces of the nominal drive, by controller", traces)
            tree[f"{base}/{TRACES}"] = hdf5.to_bytes(group)
    others = [category for category in CATEGORIES.values() if category not in categories]
    return Emitted(tree, _folders(categories), MANIFEST, _folders(others))


def _folders(categories: Iterable[Category]) -> tuple[str, ...]:
    return tuple(folder for category in categories for folder in category_folders(category))


def _pieces(
    root: Path, wanted: Sequence[tuple[Category, ControllerFile]], jobs: int
) -> Iterator[tuple[tuple[str, str], Piece]]:
    """Yield the pieces as they are done, by the names of category and controller."""
    files = len({file.name for _, file in wanted})
    if jobs == 1 or files == 1:  # starting a process takes as long as one controller's files
        for category, file in wanted:
            yield (category.name, file.name), make_piece(root, category.name, file)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        # Large controllers first, so that none is left for the end.
        order = sorted(wanted, key=lambda pair: -len(pair[1].content))
        work = {
            pool.submit(make_piece, root, category.name, file): (category.name, file.name)
            for category, file in order
        }
        for done in as_completed(work):
            yield work[done], done.result()


def all_folders() -> tuple[str, ...]:
    """Return the folders below the root that are emitted."""
    return _folders(CATEGORIES.values())


def category_folders(category: Category) -> tuple[str, ...]:
    """Return the folders below the root that hold nothing but a category's files."""
    parents = (FOLDER, SPECS, NETWORKS) if category.make else (FOLDER,)
    return tuple(f"{parent}/{category.name}" for parent in parents)


def _partitions(category: Category, controllers: Sequence[ControllerFile]) -> Group:
    """Return the partitions by label, with the instance IDs of the controllers asked."""
    asked: dict[Partition, list[str]] = {}
    for file in controllers:
        for partition in category.partitions_of(file):
            asked.setdefault(partition, []).append(file.name)
    members = {p.label: _partition(p, category.name, names) for p, names in asked.items()}
    return Group(f"partitions of the start range in the category {category.name}", members)


def _partition(partition: Partition, category: str, controllers: Sequence[str]) -> Group:
    subsets = partition.subsets
    ids: dict[str, Dataset | Group] = {
        name: Dataset(
            hdf5.text(partition.ids(f"{name}.{category}")),
            "1",
            "instance of each subset and property, [subsets, properties]",
        )
        for name in controllers
    }
    return Group(
        f"[{partition.lower}, {partition.upper}] m in subsets of {partition.width} m",
        {
            "bounds": Dataset(
                hdf5.floats([[float(x) for x in bounds] for bounds in subsets]),
                "m",
                "lower and upper bound of s, the doubles nearest to the literals, [subsets, 2]",
            ),
            "literals": Dataset(
                hdf5.text(subsets), "m", "the same bounds, exact, as decimal text, [subsets, 2]"
            ),
            "properties": Dataset(
                hdf5.text(partition.properties), "1", "properties asked about, [properties]"
            ),
            "ids": Group("instance IDs, by controller", ids),
        },
    )


def _csv(rows: Sequence[Row]) -> bytes:
    """Return VNN-COMP's instances.csv: onnx, spec, timeout; no header."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()

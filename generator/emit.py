"""Emitting the instance sets: the same controllers give the same files, byte for byte."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from generator import hdf5
from generator.categories import Category
from generator.hdf5 import Dataset, Group
from generator.hybrid.json_form import automaton_schema
from generator.hybrid.part import hybrid_part
from generator.instances import ControllerFile, benchmark_plant, make_instance
from generator.openloop.part import NETWORKS, SPECS, Asked, Draw, spec_path
from generator.partition import Partition
from generator.record import ControllerRecord, load_record
from generator.traces import trace_group
from generator.tree import TRACES, Emitted, Tree, format_json
from racecar.errors import BadInput
from racecar.experiment import default_field_of_view
from racecar.instance import format_instance, instance_schema

FOLDER = "benchmarks"
#: Version of VNN-LIB that an instances.csv names; the other versions lie beside it.
LISTED_VERSION = "1.0"
SCHEMA, MANIFEST = f"{FOLDER}/instance.schema.json", f"{FOLDER}/manifest.json"
AUTOMATON_SCHEMA = f"{FOLDER}/automaton.schema.json"


def load_controllers(root: Path) -> list[ControllerFile]:
    """Return the controllers in ROOT/onnx that have a training record, by name.

    Raises BadInput if there is none, or if a record is not the one of its controller.
    """
    files = []
    for path in sorted((root / "onnx").glob("*.json")):
        record = load_record(path, ControllerRecord)
        file = ControllerFile.load(path.with_suffix(".onnx"))
        if record.sha256 != file.sha256 or record.name != file.name:
            raise BadInput(f"{path}: it is not the record of {file.path.name}; train it again")
        files.append(file)
    if not files:
        raise BadInput(
            f"{root / 'onnx'}: it holds no controller with a training record; "
            "make one with `generator train` or choose another --root"
        )
    return files


# Products of small matrices are three times slower on two threads than on one.
@threadpool_limits.wrap(limits=1)
def build(
    root: Path,
    categories: Sequence[Category],
    controllers: Sequence[ControllerFile],
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Emitted:
    """Return every file of the categories, and the schemas.

    report(done, total) counts instances, and controllers in the categories that make networks or
    VNN-LIB specifications.
    """
    tree: Tree = {
        SCHEMA: format_json(instance_schema()),
        AUTOMATON_SCHEMA: format_json(automaton_schema()),
    }
    total = sum(
        1 if c.make else len(list(c.questions(file.name)))
        for c in categories
        for file in controllers
    )
    done = 0
    traces: dict[str, Dataset | Group] = {}
    for category in categories:
        base = f"{FOLDER}/{category.name}"
        rows = []
        for file in controllers:
            view = default_field_of_view(file.controller.rays)
            if category.make:
                plant = benchmark_plant(file.controller.rays, view)
                part = category.make(file, plant, category.name, category.timeout, Draw())
                tree |= part.files
                rows += [_row(category, asked) for asked in part.asked]
                done += 1
                report(done, total)
            instances = []
            for question in category.questions(file.name):
                spec = f"json/{question.id}.json"
                if f"{base}/{spec}" in tree:
                    raise ValueError(f"two instances have the ID {question.id}")
                instance = make_instance(question, file, view, root / base / spec)
                tree[f"{base}/{spec}"] = format_instance(instance).encode()
                rows.append((f"../../onnx/{file.path.name}", spec, category.timeout))
                instances.append(instance)
                done += 1
                report(done, total)
            if instances:
                hybrid = hybrid_part(category.packing, file, instances)
                tree |= {f"{base}/{path}": content for path, content in hybrid.items()}
            if category.traces:
                traces[file.name] = trace_group(file, view)
        if not rows:
            continue
        tree[f"{base}/instances.csv"] = _csv(rows)
        if category.partitions:
            names = [file.name for file in controllers]
            tree[f"{base}/partitions.h5"] = hdf5.to_bytes(_partitions(category, names))
        if category.traces:
            group = Group("reference traces of the nominal drive, by controller", traces)
            tree[f"{base}/{TRACES}"] = hdf5.to_bytes(group)
    inputs = {f"onnx/{file.path.name}": file.content for file in controllers}
    folders = tuple(folder for category in categories for folder in category_folders(category))
    return Emitted(tree, folders, inputs, MANIFEST)


def category_folders(category: Category) -> tuple[str, ...]:
    """Return the folders below the root that hold nothing but a category's files."""
    parents = (FOLDER, SPECS, NETWORKS) if category.make else (FOLDER,)
    return tuple(f"{parent}/{category.name}" for parent in parents)


def _row(category: Category, asked: Asked) -> tuple[str, str, int]:
    """Return a row of instances.csv, paths relative to the category's folder."""
    spec = spec_path(category.name, asked.id, LISTED_VERSION)
    return f"../../{asked.network}", f"../../{spec}", asked.timeout


def _partitions(category: Category, controllers: Sequence[str]) -> Group:
    members = {p.label: _partition(p, category.name, controllers) for p in category.partitions}
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


def _csv(rows: Sequence[tuple[str, str, int]]) -> bytes:
    """Return VNN-COMP's instances.csv: onnx, spec, timeout; no header."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()

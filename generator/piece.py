"""What one controller adds to one category: the unit of emission, made in any process."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from threadpoolctl import threadpool_limits

from generator.categories import CATEGORIES, Category
from generator.gzipped import gzipped
from generator.hdf5 import Group
from generator.hybrid.part import hybrid_part
from generator.instances import ControllerFile, benchmark_plant, make_instance
from generator.openloop.part import Asked, Draw, spec_path
from generator.traces import trace_group
from generator.tree import Tree
from racecar.experiment import default_field_of_view
from racecar.instance import format_instance

FOLDER = "benchmarks"
#: Version of VNN-LIB that an instances.csv names; the other versions lie beside it.
LISTED_VERSION = "1.0"

#: VNN-COMP's columns: onnx, spec, timeout in seconds; paths relative to the category's folder.
Row = tuple[str, str, int]


@dataclass
class Piece:
    """Files by path below the root, the rows of instances.csv, the reference traces if any."""

    files: Tree = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    traces: Group | None = None


# Products of small matrices are three times slower on two threads than on one.
@threadpool_limits.wrap(limits=1)
def make_piece(root: Path, name: str, file: ControllerFile) -> Piece:
    """Return what a controller adds to the category of a name; nothing if it is not asked.

    root: instances name their controller's file relative to where they are to lie.
    """
    category, piece = CATEGORIES[name], Piece()
    if not category.asks(file.controller.rays):
        return piece
    if category.make:
        _add_networks(piece, category, file)
    view = default_field_of_view(file.controller.rays)
    base, instances = f"{FOLDER}/{name}", []
    for question in category.questions(file):
        spec = f"json/{question.id}.json"
        if f"{base}/{spec}" in piece.files:
            raise ValueError(f"two instances have the ID {question.id}")
        instance = make_instance(question, file, view, root / base / spec)
        piece.files[f"{base}/{spec}"] = format_instance(instance).encode()
        piece.rows.append((f"../../onnx/{file.path.name}", spec, category.timeout))
        instances.append(instance)
    if instances and category.printed(file):
        hybrid = hybrid_part(category.packing, file, instances)
        piece.files |= {f"{base}/{path}": content for path, content in hybrid.items()}
    if category.traces:
        piece.traces = trace_group(file, view)
    return piece


def _add_networks(piece: Piece, category: Category, file: ControllerFile) -> None:
    """Add networks and VNN-LIB specifications, gzipped as VNN-COMP publishes them."""
    assert category.make is not None
    rays = file.controller.rays
    plant = benchmark_plant(rays, default_field_of_view(rays))
    part = category.make(file, plant, category.name, category.timeout, Draw())
    piece.files |= {f"{path}.gz": gzipped(content) for path, content in part.files.items()}
    piece.rows += [_row(category, asked) for asked in part.asked]


def _row(category: Category, asked: Asked) -> Row:
    """Return a row of instances.csv; the names in it are those of the unpacked files."""
    spec = spec_path(category.name, asked.id, LISTED_VERSION)
    return f"../../{asked.network}", f"../../{spec}", asked.timeout

"""Benchmarks as VNN-COMP 2026 publishes them, and competition sets from a seed.

    OUT/benchmarks/NAME/{1.0,2.0}/{instances.csv,onnx/*.onnx.gz,vnnlib/*.vnnlib.gz}
    OUT/benchmarks/NAME/generate_properties.py SEED
    OUT/benchmarks/NAME/controllers/*.onnx.gz     what generate_properties.py starts from

An instances.csv has no header; its rows are onnx, vnnlib, timeout, paths without ".gz".
"""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from generator.categories import CATEGORIES, Category
from generator.gzipped import gzipped, unpacked
from generator.instances import ControllerFile, benchmark_plant
from generator.openloop.part import Asked, Draw, Part, spec_path
from generator.openloop.printer import VERSIONS
from generator.tree import Tree
from racecar.controller import parse_controller, write_whole
from racecar.errors import BadInput
from racecar.experiment import default_field_of_view
from racecar.instance import read_text

#: The timeouts of a competition set sum to at most so many seconds.
BUDGET = 6 * 3600
_CONTROLLERS, _SCRIPT = "controllers", "generate_properties.py"
_SCRIPT_TEXT = '''"""Make a competition set: python generate_properties.py SEED.

Writes 1.0/ and 2.0/ beside this file anew. The package closedlap must be installed.
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    if len(sys.argv) != 2 or not sys.argv[1].isdecimal():
        sys.exit("usage: python generate_properties.py SEED (a whole number)")
    from generator.vnncomp import generate_properties

    made = generate_properties(Path(__file__).resolve().parent, "{category}", int(sys.argv[1]))
    print(f"{made.instances} instances, timeouts of {made.seconds} s in all")
'''


@dataclass(frozen=True)
class Exported:
    """What was written for a category: how many instances, and their timeouts' sum (s)."""

    category: str
    folder: Path
    instances: int
    seconds: int


def export_vnncomp(
    root: Path,
    out: Path,
    controllers: Sequence[ControllerFile],
    names: Iterable[str] = (),
    report: Callable[[int, int], None] = lambda done, total: None,
) -> list[Exported]:
    """Write the emitted instances of the VNN-LIB categories as benchmarks of VNN-COMP.

    Args:
        root: where they were emitted to, with benchmarks/, onnx/ and vnnlib/.
        out: the folder to write to; it must not hold these benchmarks yet.
        controllers: those of the root; generate_properties.py needs them.
        names: of categories; all that have VNN-LIB specifications if empty.
        report: is told how many categories of how many are done.

    Raises:
        BadInput: if something is missing or in the way.
    """
    chosen = [_category(name) for name in names] or [c for c in CATEGORIES.values() if c.make]
    folders = [out / "benchmarks" / benchmark_name(category.name) for category in chosen]
    for folder in folders:
        if folder.exists():
            raise BadInput(f"{folder}: it is there already; choose another folder")
    parts = [_emitted(root, category) for category in chosen]
    written = []
    for done, (category, folder, part) in enumerate(zip(chosen, folders, parts, strict=True)):
        tree = _layout(category.name, part) | _beside(category.name, controllers)
        _replace({folder: tree})
        seconds = sum(asked.timeout for asked in part.asked)
        written.append(Exported(category.name, folder, len(part.asked), seconds))
        report(done + 1, len(chosen))
    return written


def generate_properties(folder: Path, name: str, seed: int) -> Exported:
    """Make a competition set in the folder of a benchmark; the same seed gives the same files.

    The nominal drives start where the seed says, so that the instances are new; of all that can
    be asked, a random choice is kept, with timeouts that sum to at most BUDGET.
    """
    category = _category(name)
    part = Part()
    for file in _load_controllers(folder / _CONTROLLERS):
        more = _drawn(category, file, seed)
        part.files |= more.files
        part.asked += more.asked
    part.asked = choose(part.asked, seed)
    tree = _layout(name, part)
    _replace(
        {
            folder / version: {
                path.removeprefix(f"{version}/"): content
                for path, content in tree.items()
                if path.startswith(f"{version}/")
            }
            for version in VERSIONS
        }
    )
    return Exported(name, folder, len(part.asked), sum(asked.timeout for asked in part.asked))


def choose(asked: Sequence[Asked], seed: int, budget: int = BUDGET) -> list[Asked]:
    """Return a random choice, in the given order, whose timeouts sum to at most the budget."""
    order = np.random.default_rng(seed).permutation(len(asked))
    kept, spent = set(), 0
    for i in order.tolist():
        if spent + asked[i].timeout <= budget:
            kept.add(i)
            spent += asked[i].timeout
    return [asked[i] for i in sorted(kept)]


def benchmark_name(category: str) -> str:
    """Return what a category is called among other people's benchmarks."""
    return f"closedlap_{category}"


def _category(name: str) -> Category:
    known = [category.name for category in CATEGORIES.values() if category.make]
    if name not in known:
        raise BadInput(f"category {name!r} has no VNN-LIB form; choose one of {', '.join(known)}")
    return CATEGORIES[name]


def _emitted(root: Path, category: Category) -> Part:
    """Read the instances of a category from an emitted tree."""
    table = root / "benchmarks" / category.name / "instances.csv"
    part = Part()
    for row in csv.reader(read_text(table).decode().splitlines()):
        if len(row) != 3 or not row[2].isdecimal():
            raise BadInput(f"{table}: {','.join(row)!r} is not onnx, spec, timeout; emit it again")
        network, id = row[0].removeprefix("../../"), PurePosixPath(row[1]).stem
        part.asked.append(Asked(id, network, int(row[2])))
        for path in (network, *(spec_path(category.name, id, version) for version in VERSIONS)):
            part.files.setdefault(path, _plain(root / path))
    return part


def _plain(path: Path) -> bytes:
    """Return what an emitted file holds, which may be there with .gz after its name only."""
    packed = path.with_name(f"{path.name}.gz")
    if path.exists() or not packed.exists():
        return read_text(path)
    return unpacked(packed)


def _drawn(category: Category, file: ControllerFile, seed: int) -> Part:
    assert category.make is not None
    rays = file.controller.rays
    plant = benchmark_plant(rays, default_field_of_view(rays))
    part = category.make(file, plant, category.name, category.timeout, Draw.of(seed, file.name))
    part.files.setdefault(f"onnx/{file.path.name}", file.content)
    return part


def _layout(category: str, part: Part) -> Tree:
    """Return the published files by path below the benchmark's folder."""
    tree: Tree = {}
    for version in VERSIONS:
        rows = io.StringIO()
        for asked in part.asked:
            network, spec = f"onnx/{PurePosixPath(asked.network).name}", f"vnnlib/{asked.id}.vnnlib"
            rows.write(f"{network},{spec},{asked.timeout}\n")
            content = part.files[spec_path(category, asked.id, version)]
            tree[f"{version}/{spec}.gz"] = gzipped(content)
            if f"{version}/{network}.gz" not in tree:
                tree[f"{version}/{network}.gz"] = gzipped(part.files[asked.network])
        tree[f"{version}/instances.csv"] = rows.getvalue().encode()
    return tree


def _beside(category: str, controllers: Sequence[ControllerFile]) -> Tree:
    """Return the script that makes competition sets and what it needs."""
    tree = {f"{_CONTROLLERS}/{file.path.name}.gz": gzipped(file.content) for file in controllers}
    return tree | {_SCRIPT: _SCRIPT_TEXT.replace("{category}", category).encode()}


def _load_controllers(folder: Path) -> list[ControllerFile]:
    files = []
    for path in sorted(folder.glob("*.onnx.gz")):
        content = unpacked(path)
        name = path.with_suffix("")
        files.append(ControllerFile(name, content, parse_controller(content, str(name))))
    if not files:
        raise BadInput(f"{folder}: it holds no controllers; export again")
    return files


def _replace(trees: Mapping[Path, Tree]) -> None:
    """Put trees in the place of folders, all of them written before the first is put there."""
    parts = {folder: folder.with_name(f".{folder.name}.part") for folder in trees}
    for folder, tree in trees.items():
        shutil.rmtree(parts[folder], ignore_errors=True)
        for path, content in tree.items():
            write_whole(parts[folder] / path, content)
    for folder, part in parts.items():
        shutil.rmtree(folder, ignore_errors=True)
        part.rename(folder)

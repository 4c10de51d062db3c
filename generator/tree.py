"""Trees of emitted files: written, compared with what is there, summed up in a manifest.

A tree is built whole in memory. What need not repeat on another machine are packed files: the
last bits of reference traces depend on its mathematical library and on how a matrix product is
split, the bytes of any HDF5 file may depend on the HDF5 library, those of a gzip file on zlib. So
a check compares HDF5 files by content (real numbers of traces to 1e-9, everything else exactly),
gzip files by what they hold, and proves the bytes of both unharmed by the manifest; all other
files are compared byte for byte.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path

from generator import hdf5
from racecar.controller import write_whole

#: File contents by path relative to the root, with forward slashes.
Tree = dict[str, bytes]
#: A manifest's entries by path: sha256 and size in bytes.
Entries = dict[str, dict[str, str | int]]

#: The folders that a manifest covers.
DATA = ("benchmarks", "onnx", "vnnlib")
TRACES, TRACE_TOLERANCE = "traces.h5", 1e-9
#: What lies in an emitted folder and begins with this was made by another command.
REFERENCE = "reference"


@dataclass(frozen=True)
class Emitted:
    """What is to lie under a root.

    tree: the files; folders: those that hold nothing else, each two levels deep; manifest: path of
    the manifest, which covers the tree and everything else in DATA; elsewhere: folders that are
    emitted, too, but not now: what the manifest says about them stays.
    """

    tree: Tree
    folders: tuple[str, ...]
    manifest: str
    elsewhere: tuple[str, ...] = ()


@dataclass(frozen=True)
class Differences:
    """What a check found; paths relative to the root.

    differ: files with other content than would be emitted; missing: files that would be
    emitted; stale: files in an emitted folder that would not be.
    """

    differ: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    stale: list[str] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.differ or self.missing or self.stale)


def write_tree(root: Path, emitted: Emitted) -> tuple[list[str], list[str]]:
    """Write what is not there yet and remove what is stale; return both lists of paths.

    A packed file that another machine packed alike, and that is as its manifest says, stays. The
    new manifest comes last: where it is current, the rest is complete.
    """
    tree = emitted.tree | _packed_alike(root, emitted)
    written = [path for path, content in tree.items() if update_file(root / path, content)]
    removed = _stale(root, emitted)
    for path in removed:
        (root / path).unlink()
    for folder in emitted.folders:
        _remove_empty(root / folder)
    if update_file(root / emitted.manifest, _manifest(root, emitted, tree)):
        written.append(emitted.manifest)
    return written, removed


def check_tree(root: Path, emitted: Emitted) -> Differences:
    """Compare the files under the root with what would be emitted; write nothing."""
    found = Differences(stale=_stale(root, emitted))
    equivalent: Tree = {}
    for path, content in emitted.tree.items():
        existing = file_content(root / path)
        if existing is None:
            found.missing.append(path)
        elif not _same(path, existing, content):
            found.differ.append(path)
        else:
            equivalent[path] = existing
    existing = file_content(root / emitted.manifest)
    if existing is None:
        found.missing.append(emitted.manifest)
    elif existing != _manifest(root, emitted, emitted.tree | equivalent):
        found.differ.append(emitted.manifest)
    return found


def _packed_alike(root: Path, emitted: Emitted) -> Tree:
    """Return the packed files that are there, hold what they should, and are unharmed."""
    entries, found = _entries(root, emitted), {}
    for path, content in emitted.tree.items():
        if path.endswith((".gz", ".h5")) and (existing := file_content(root / path)) is not None:
            unharmed = entries.get(path) == _entry(existing)
            if unharmed and _same(path, existing, content):
                found[path] = existing
    return found


def _same(path: str, existing: bytes, content: bytes) -> bool:
    if existing == content:
        return True
    if path.endswith(".gz"):
        return _unpacked(existing) == _unpacked(content)
    if path.endswith(".h5"):
        tolerance = TRACE_TOLERANCE if path.endswith(f"/{TRACES}") else 0.0
        return not hdf5.differences(existing, content, tolerance)
    return False


def _unpacked(content: bytes) -> bytes | None:
    try:
        return gzip.decompress(content)
    except (OSError, EOFError, zlib.error):  # damaged
        return None


def _manifest(root: Path, emitted: Emitted, tree: Tree) -> bytes:
    """Return the manifest of a tree and of what else is there, one file a line."""
    entries = _other_entries(root, emitted) | {path: _entry(x) for path, x in tree.items()}
    lines = (f"{json.dumps(path)}: {json.dumps(entries[path])}" for path in sorted(entries))
    head = '{"format": "closedlap-manifest", "version": "1.0", "files": {'
    return "\n".join([head, ",\n".join(lines), "}}", ""]).encode()


def _entry(content: bytes) -> dict[str, str | int]:
    return {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content)}


def _entries(root: Path, emitted: Emitted) -> Entries:
    """Return the entries of the present manifest, none if it is not one."""
    try:
        return dict(json.loads(file_content(root / emitted.manifest) or b"{}")["files"])
    except (ValueError, KeyError, TypeError):
        return {}


def refresh_manifest(root: Path, manifest: str, folders: tuple[str, ...]) -> bytes:
    """Return the manifest with what it says about the emitted folders as it is, the rest anew."""
    return _manifest(root, Emitted({}, (), manifest, folders), {})


def is_as_listed(root: Path, manifest: str, path: str) -> bool:
    """Whether a file is there with the bytes that the manifest says."""
    content = file_content(root / path)
    known = _entries(root, Emitted({}, (), manifest)).get(path)
    return content is not None and known == _entry(content)


def _other_entries(root: Path, emitted: Emitted) -> Entries:
    """Return the entries of what is in DATA besides the tree, is not stale, and stays."""
    known, entries = _entries(root, emitted), {}
    for folder in DATA:
        for path in _files(root / folder):
            name = path.relative_to(root).as_posix()
            if name == emitted.manifest or name in emitted.tree or _made(name, emitted.folders):
                continue
            if "__pycache__" in path.parts:  # the folder's one program was imported
                continue
            if not _made(name, emitted.elsewhere):
                entries[name] = _entry(path.read_bytes())
            elif name in known:
                entries[name] = known[name]
    return entries


def _stale(root: Path, emitted: Emitted) -> list[str]:
    return [
        name
        for folder in emitted.folders
        for path in _files(root / folder)
        if (name := path.relative_to(root).as_posix()) not in emitted.tree
        and _made(name, emitted.folders)
    ]


def _made(name: str, folders: tuple[str, ...]) -> bool:
    """Whether a path lies in one of the folders and is not kept there for another command."""
    return any(
        name.startswith(f"{folder}/") and not name.startswith(f"{folder}/{REFERENCE}")
        for folder in folders
    )


def _files(folder: Path) -> list[Path]:
    """Return everything in a folder but folders, in order."""
    found = sorted(folder.rglob("*"))
    return [path for path in found if path.is_symlink() or not path.is_dir()]


def _remove_empty(folder: Path) -> None:
    """Remove folders in which nothing is left, the innermost first."""
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            path.rmdir()


def update_file(path: Path, content: bytes) -> bool:
    """Write a file unless it holds the content already; return whether it was written."""
    if file_content(path) == content:
        return False
    write_whole(path, content)
    return True


def file_content(path: Path) -> bytes | None:
    """Return what a file holds; None if it is not there."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None


def format_json(data: object) -> bytes:
    """Return JSON text that ends with a line feed."""
    return (json.dumps(data, indent=2, allow_nan=False) + "\n").encode()

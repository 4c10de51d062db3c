"""The published controllers: those in ROOT/onnx that have a training record."""

from __future__ import annotations

from pathlib import Path

from generator.instances import ControllerFile
from generator.record import ControllerRecord, load_record
from racecar.errors import BadInput


def published_names(root: Path) -> list[str]:
    """Return the names of the published controllers, in order; BadInput if there is none."""
    names = [path.stem for path in sorted((root / "onnx").glob("*.json"))]
    if not names:
        raise BadInput(
            f"{root / 'onnx'}: it holds no controller with a training record; "
            "make one with `generator train` or choose another --root"
        )
    return names


def load_published(root: Path, name: str) -> tuple[ControllerFile, ControllerRecord]:
    """Return a published controller and its record.

    Raises BadInput if one of them is missing or broken, or the record is not the controller's.
    """
    path = root / "onnx" / f"{name}.json"
    record = load_record(path, ControllerRecord)
    file = ControllerFile.load(path.with_suffix(".onnx"))
    if record.sha256 != file.sha256 or record.name != name:
        raise BadInput(f"{path}: it is not the record of {file.path.name}; train it again")
    return file, record

"""Records: how a controller came to be, as JSON beside its ONNX file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from generator.hyperparams import AnyHyperparameters
from generator.nominal import Nominal
from racecar.controller import write_whole
from racecar.errors import BadInput
from racecar.instance import read_text

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SeedRecord(_Record):
    """One training.

    setup: the family, such as TD3_L21_64x64; sha256: of the ONNX file; nominal: how it drives
    without faults; libraries: versions, by name; export_error: largest difference (rad)
    between the ONNX file's network and the trained actor on random scans.
    """

    setup: str
    seed: int
    sha256: Sha256
    nominal: Nominal
    hyperparameters: AnyHyperparameters
    libraries: dict[str, str]
    python: str
    export_error: float


class Tried(_Record):
    """How a seed came out that was tried on the way."""

    seed: int
    finishes_turn: bool
    safe_fraction: float


class ControllerRecord(SeedRecord):
    """A controller with a name.

    label: "safe" if all nominal starts keep a positive margin in continuous time; tried: the
    seeds up to this one; the controller's index counts those that finish the turn.
    """

    name: str
    label: Literal["safe", "unsafe"]
    tried: list[Tried]


AnyRecord = TypeVar("AnyRecord", SeedRecord, ControllerRecord)


def load_record(path: Path, kind: type[AnyRecord]) -> AnyRecord:
    """Read a record; BadInput if it is missing, broken or of another kind."""
    try:
        return kind.model_validate_json(read_text(path))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(x) for x in first["loc"])
        raise BadInput(f"{path}: {place + ': ' if place else ''}{first['msg']}") from None


def format_record(record: SeedRecord) -> str:
    """Return a record as JSON text."""
    data = record.model_dump(mode="json", exclude_none=True)
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def save_record(record: SeedRecord, path: Path) -> None:
    """Write a record, whole or not at all."""
    write_whole(path, format_record(record).encode())

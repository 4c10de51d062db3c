"""The seeds of a setup, one after the other: what each gave, kept in a folder of its own.

Controller i of a setup is the i-th seed, counting 1, 2, 3, ..., whose controller finishes the
turn, safe or not. What a seed gave is kept, so that C2 need not train again what C1 tried: in
its folder, and in the records of the controllers that were published.
"""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from generator.hyperparams import AnyHyperparameters
from generator.nominal import Nominal
from generator.record import ControllerRecord, SeedRecord, Tried, load_record, save_record
from generator.setups import Setup
from racecar.controller import Controller, save_controller, write_whole
from racecar.errors import BadInput

CONTROLLER, CURVE, RECORD, CHECKPOINT = (
    "controller.onnx",
    "curve.csv",
    "record.json",
    "checkpoint.pt",
)


@dataclass(frozen=True)
class Trained:
    """What a training left.

    curve: one row per chunk of the training; libraries: versions, by name; export_error:
    largest difference (rad) between the controller and the network it was exported from.
    """

    controller: Controller
    nominal: Nominal
    curve: list[dict[str, float]]
    libraries: dict[str, str]
    export_error: float


def training_settings(
    setup: Setup, seed: int, parameters: AnyHyperparameters, libraries: dict[str, str]
) -> dict[str, Any]:
    """Return what a training was asked to do: a checkpoint of other settings is refused."""
    return {
        "setup": setup.family,
        "seed": seed,
        "hyperparameters": parameters.model_dump(),
        "libraries": libraries,
    }


#: Trains one seed, in a folder where it may keep a checkpoint.
Train = Callable[[Setup, int, AnyHyperparameters, Path], Trained]


def find_controller(
    setup: Setup,
    parameters: AnyHyperparameters,
    work: Path,
    max_seeds: int,
    train: Train,
    tell: Callable[[SeedRecord], None] = lambda record: None,
    known: Mapping[int, Tried] | None = None,
) -> tuple[ControllerRecord, Path] | None:
    """Try seeds until the setup's controller is found.

    work: holds FAMILY/seed_N for each seed; tell: called after each seed that has a folder
    there; known: what seeds gave elsewhere (published_seeds). One without a folder is not
    trained again, unless it is the controller. Returns the record and the folder of the seed,
    or None if ``max_seeds`` seeds did not give enough controllers that finish the turn. Raises
    BadInput if a folder is in use or holds another training.
    """
    tried: list[Tried] = []
    for seed in range(1, max_seeds + 1):
        folder = work / setup.family / f"seed_{seed}"
        before = sum(x.finishes_turn for x in tried)
        elsewhere = None if folder.exists() else (known or {}).get(seed)
        if elsewhere and before + elsewhere.finishes_turn < setup.index:
            tried.append(elsewhere)
            continue
        record = try_seed(setup, seed, parameters, folder, train)
        tell(record)
        tried.append(
            Tried(
                seed=seed,
                finishes_turn=record.nominal.finishes_turn,
                safe_fraction=record.nominal.safe_fraction,
            )
        )
        if before + record.nominal.finishes_turn == setup.index:
            fields = record.model_dump() | {"name": setup.name, "tried": tried}
            return ControllerRecord(label=record.nominal.label, **fields), folder
    return None


def published_seeds(setup: Setup, parameters: AnyHyperparameters, out: Path) -> dict[int, Tried]:
    """Return what the seeds gave that published controllers of a setup tried, by seed.

    Only controllers in ``out`` that were trained with these hyper-parameters and the installed
    libraries count. Raises BadInput if a record there is broken.
    """
    found: dict[int, Tried] = {}
    for path in sorted(out.glob(f"{setup.family}_C*.json")):
        record = load_record(path, ControllerRecord)
        installed = all(_version(name) == x for name, x in record.libraries.items())
        if record.setup == setup.family and record.hyperparameters == parameters and installed:
            found |= {x.seed: x for x in record.tried}
    return found


def _version(library: str) -> str | None:
    try:
        return version(library)
    except PackageNotFoundError:
        return None


def try_seed(
    setup: Setup, seed: int, parameters: AnyHyperparameters, folder: Path, train: Train
) -> SeedRecord:
    """Return what a seed gave: from its folder, or by training (from a checkpoint there)."""
    with _only_user(folder):
        if (folder / RECORD).exists():
            record = load_record(folder / RECORD, SeedRecord)
            _check_same(record, parameters, folder)
        else:
            trained = train(setup, seed, parameters, folder)
            record = _keep(setup, seed, parameters, trained, folder)
        (folder / CHECKPOINT).unlink(missing_ok=True)
    return record


def publish(record: ControllerRecord, folder: Path, out: Path) -> list[Path]:
    """Copy a found controller, its curve and its record to ``out``; return the files.

    The record comes last: where it lies, the rest is complete. Raises BadInput if another
    controller of that name is there: names are for ever.
    """
    onnx, curve = out / f"{record.name}.onnx", out / f"{record.name}.curve.csv"
    content = (folder / CONTROLLER).read_bytes()
    if onnx.exists() and onnx.read_bytes() != content:
        raise BadInput(
            f"{onnx}: holds another controller of this name; "
            f"remove it or choose another --out (the new one is in {folder})"
        )
    write_whole(onnx, content)
    write_whole(curve, (folder / CURVE).read_bytes())
    save_record(record, out / f"{record.name}.json")
    return [onnx, curve, out / f"{record.name}.json"]


def _keep(
    setup: Setup, seed: int, parameters: AnyHyperparameters, trained: Trained, folder: Path
) -> SeedRecord:
    save_controller(trained.controller, folder / CONTROLLER)
    write_whole(folder / CURVE, format_curve(trained.curve).encode())
    record = SeedRecord(
        setup=setup.family,
        seed=seed,
        sha256=file_sha256(folder / CONTROLLER),
        nominal=trained.nominal,
        hyperparameters=parameters,
        libraries=trained.libraries,
        python=platform.python_version(),
        export_error=trained.export_error,
    )
    save_record(record, folder / RECORD)
    return record


def _check_same(record: SeedRecord, parameters: AnyHyperparameters, folder: Path) -> None:
    if record.hyperparameters != parameters:
        raise BadInput(
            f"{folder}: it was trained with other hyper-parameters or timesteps; "
            "choose another --work or remove it"
        )
    if file_sha256(folder / CONTROLLER) != record.sha256:
        raise BadInput(f"{folder / CONTROLLER}: it is not the one of its record; remove {folder}")


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def _only_user(folder: Path) -> Iterator[None]:
    """Keep a second process out of a seed's folder; the system frees the lock if we die."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise BadInput(f"{folder}: another process trains here; wait for it") from None
        yield


def format_curve(curve: list[dict[str, float]]) -> str:
    """Return a learning curve as CSV text."""
    text = io.StringIO()
    writer = csv.DictWriter(text, curve[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(curve)
    return text.getvalue()

"""A run folder: durable records, one per instance, and what they refer to.

- run.json: what the run shares (records.RunInfo)
- records/ID.json: one result; it is written last, so it stands for all the rest
- witnesses/ID.json: what the tool wrote after ``sat``
- checks/ID.json: the independent check of that witness
- logs/ID.log: what the tool printed (the middle of a long log is left out)
- results.csv: VNN-COMP's six columns, written at the end
- lock: held while a harness works here
"""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from harness.files import sync_folder, write_durable
from harness.records import Data, Record, RunInfo, WitnessCheck
from racecar.errors import BadInput

#: How long (seconds) to wait for a harness that is just ending.
LOCK_PATIENCE_S = 3.0

SomeData = TypeVar("SomeData", bound=Data)


class RunFolder:
    """The files of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, path: Path) -> RunFolder:
        """Make a new, empty run folder; BadInput if there is something at ``path``."""
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            raise BadInput(
                f"{path}: it exists; add --resume to continue it, or give another folder with --out"
            ) from None
        sync_folder(path.parent)
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Return an existing run; BadInput if there is none at ``path``."""
        try:
            names = {file.name for file in path.iterdir()}
        except OSError as error:
            raise BadInput(f"{path}: not a run folder ({error.strerror})") from None
        # A harness that was killed at once may have left nothing but a lock.
        if "run.json" not in names and names - {"lock", ".run.json.part"}:
            raise BadInput(f"{path}: not a run folder (it has no run.json)")
        return cls(path)

    def lock(self) -> int:
        """Exclude other harnesses; return the file descriptor that holds the lock.

        The lock ends when every process that holds the descriptor has ended.
        """
        fd = os.open(self.path / "lock", os.O_RDWR | os.O_CREAT, 0o644)
        give_up = time.monotonic() + LOCK_PATIENCE_S
        while True:
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > give_up:
                    os.close(fd)
                    raise BadInput(f"{self.path}: another harness is working on it") from None
                time.sleep(0.05)
            else:
                return fd

    @property
    def info_path(self) -> Path:
        """Where the run's own description stands."""
        return self.path / "run.json"

    def info(self) -> RunInfo:
        """Return what the run shares."""
        return _read(self.info_path, RunInfo)

    def write_info(self, info: RunInfo) -> None:
        """Write what the run shares."""
        write_durable(self.info_path, to_json(info))

    def record_path(self, instance: str) -> Path:
        """Return where the record of an instance stands, or would stand."""
        return self.path / "records" / f"{instance}.json"

    def record(self, instance: str) -> Record:
        """Return the record of an instance."""
        return _read(self.record_path(instance), Record)

    def records(self) -> list[Record]:
        """Return all records, ordered by category and instance."""
        files = (self.path / "records").glob("[!.]*.json")
        records = [_read(file, Record) for file in files]
        return sorted(records, key=lambda r: (r.category, r.instance))

    def write_record(self, record: Record) -> None:
        """Write a record; all that it refers to must have been written."""
        write_durable(self.record_path(record.instance), to_json(record))

    def witness(self, record: Record) -> bytes:
        """Return what the tool wrote after ``sat``; nothing where it wrote nothing."""
        if record.witness is None:
            return b""
        try:
            return (self.path / "witnesses" / record.witness).read_bytes()
        except OSError as error:
            raise BadInput(f"{self.path}: witness {record.witness}: {error.strerror}") from None

    def write_witness(self, instance: str, content: bytes) -> str:
        """Write a witness and return its file name."""
        name = f"{instance}.json"
        write_durable(self.path / "witnesses" / name, content)
        return name

    def check(self, instance: str) -> WitnessCheck | None:
        """Return the stored check of an instance's witness, if there is one."""
        path = self.path / "checks" / f"{instance}.json"
        return _read(path, WitnessCheck) if path.is_file() else None

    def write_check(self, check: WitnessCheck) -> None:
        """Write the check of a witness."""
        write_durable(self.path / "checks" / f"{check.instance}.json", to_json(check))

    def write_log(self, name: str, content: bytes) -> None:
        """Write what the tool printed."""
        write_durable(self.path / "logs" / name, content, sync=False)


def to_json(data: Data) -> bytes:
    """Return the JSON file of some data."""
    return (data.model_dump_json(indent=2) + "\n").encode()


def _read(path: Path, kind: type[SomeData]) -> SomeData:
    try:
        return kind.model_validate_json(path.read_bytes())
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(x) for x in first["loc"])
        raise BadInput(f"{path}: {place + ': ' if place else ''}{first['msg']}") from None

"""The runs that a site is made of: where they lie, read once, and named by a hash."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

from harness.records import Record, RunInfo, WitnessCheck
from harness.store import RunFolder
from racecar.errors import BadInput


class JudgedRun(RunFolder):
    """A run folder whose records are read once; nothing is written to it."""

    @cached_property
    def _read(self) -> list[Record]:
        return super().records()

    def records(self) -> list[Record]:
        """Return all records, ordered by category and instance."""
        return self._read

    def check(self, instance: str) -> WitnessCheck | None:
        """Return the stored check of an instance's witness, if there is one."""
        if instance not in self._checks:
            self._checks[instance] = super().check(instance)
        return self._checks[instance]

    @cached_property
    def _checks(self) -> dict[str, WitnessCheck | None]:
        return {}

    @cached_property
    def shared(self) -> RunInfo:
        """What the run shares."""
        return super().info()

    @cached_property
    def sha256(self) -> str:
        """A hash of all that the run says: itself, its records and the checks of its witnesses.

        Over the JSON text of each in turn, records ordered by category and instance, each ended
        by a line feed. Logs do not count.
        """
        digest = hashlib.sha256()
        digest.update(self.shared.model_dump_json().encode() + b"\n")
        for record in self.records():
            digest.update(record.model_dump_json().encode() + b"\n")
            check = self.check(record.instance) if record.witness else None
            if check is not None:
                digest.update(check.model_dump_json().encode() + b"\n")
        return digest.hexdigest()


def find_runs(paths: Iterable[Path]) -> list[JudgedRun]:
    """Return the runs at the given paths, each once; a path may be a folder of runs.

    Raises BadInput for a path that is neither.
    """
    found: dict[Path, JudgedRun] = {}
    for path in paths:
        for run in _runs_at(path):
            found.setdefault(run.path.resolve(), run)
    return list(found.values())


def _runs_at(path: Path) -> list[JudgedRun]:
    try:
        return [_open(path)]
    except BadInput as error:
        runs = []
        for folder in sorted(path.iterdir()) if path.is_dir() else []:
            if folder.is_dir() and not folder.name.startswith("."):
                runs.append(_open(folder))
        if not runs:
            raise error from None
        return runs


def _open(path: Path) -> JudgedRun:
    run = JudgedRun.open(path)
    assert isinstance(run, JudgedRun)
    _ = run.shared  # a folder that is empty, or whose description is broken, is refused here
    return run

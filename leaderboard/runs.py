"""The runs that a site is made of: where they lie, read once, and named by a hash."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

from harness.records import Record, RunInfo, WitnessCheck
from harness.store import RunFolder
from racecar.errors import BadInput

#: What `harness submit` writes.
ENDINGS = (".tar.gz", ".tgz")


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


def find_runs(paths: Iterable[Path], root: Path | None = None) -> list[JudgedRun]:
    """Return the runs at the given paths, each once.

    A path is a run folder, a submission, or a folder of these. root: the benchmarks folder, against
    which submissions are verified. Raises BadInput for a path that is none of them.
    """
    found: dict[Path, list[JudgedRun]] = {}
    for path in paths:
        for place in _places(path):
            if place.resolve() not in found:
                found[place.resolve()] = _open(place, root)
    return [run for runs in found.values() for run in runs]


def _places(path: Path) -> list[Path]:
    """Return where runs lie: the path itself, or those in a folder that is no run."""
    if path.is_file() or not path.is_dir():
        return [path]
    try:
        _open_folder(path)
    except BadInput as error:
        inside = [
            place
            for place in sorted(path.iterdir())
            if not place.name.startswith(".") and (place.is_dir() or _is_submission(place))
        ]
        if not inside:
            raise error from None
        return inside
    return [path]


def _is_submission(path: Path) -> bool:
    return path.is_file() and path.name.endswith(ENDINGS)


def _open(path: Path, root: Path | None) -> list[JudgedRun]:
    if not _is_submission(path):
        return [_open_folder(path)]
    from leaderboard.submitted import read_submission  # noqa: PLC0415 (it imports this module)

    return read_submission(path, root)


def _open_folder(path: Path) -> JudgedRun:
    run = JudgedRun.open(path)
    assert isinstance(run, JudgedRun)
    _ = run.shared  # a folder that is empty, or whose description is broken, is refused here
    return run

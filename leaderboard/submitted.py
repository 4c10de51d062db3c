"""Submissions in the place of runs: verified, then read from the archive into memory."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from harness.records import Record, RunInfo, WitnessCheck
from leaderboard.runs import JudgedRun
from racecar.errors import BadInput


class SubmittedRun(JudgedRun):
    """One run of a submission. It has no logs: submissions do not carry them."""

    def __init__(
        self,
        path: Path,
        info: RunInfo,
        records: list[Record],
        checks: dict[str, WitnessCheck],
        witnesses: dict[str, bytes],
    ) -> None:
        super().__init__(path)
        self._info = info
        self._records = sorted(records, key=lambda r: (r.category, r.instance))
        self._witnesses = witnesses
        self._by_instance = checks

    def info(self) -> RunInfo:
        """Return what the run shares."""
        return self._info

    @property
    def shared(self) -> RunInfo:  # type: ignore[override]
        """What the run shares."""
        return self._info

    def records(self) -> list[Record]:
        """Return all records, ordered by category and instance."""
        return self._records

    def check(self, instance: str) -> WitnessCheck | None:
        """Return the check of an instance's witness, if there is one."""
        return self._by_instance.get(instance)

    def witness(self, record: Record) -> bytes:
        """Return what the tool wrote after ``sat``."""
        check = self.check(record.instance)
        return self._witnesses[check.witness_sha256] if check else b""

    def log(self, record: Record) -> bytes:
        """Return nothing: see the class."""
        del record
        return b""


def read_submission(path: Path, root: Path | None) -> list[JudgedRun]:
    """Return the runs in a submission; BadInput unless it is valid.

    root: the benchmarks folder, against which it is verified: every witness is replayed.
    """
    from harness.submission.archive import read_archive  # noqa: PLC0415 (needed for these only)
    from harness.submission.source import open_submission  # noqa: PLC0415

    open_submission(path, root)
    files = dict(read_archive(path))
    prefix = "witnesses/"
    witnesses = {n.removeprefix(prefix): c for n, c in files.items() if n.startswith(prefix)}
    runs: list[JudgedRun] = []
    try:
        while f"runs/{len(runs)}/run.json" in files:
            folder = f"runs/{len(runs)}"
            info = RunInfo.model_validate_json(files[f"{folder}/run.json"])
            lines = files[f"{folder}/records.jsonl"].splitlines()
            records = [Record.model_validate_json(line) for line in lines]
            lines = files[f"{folder}/checks.jsonl"].splitlines()
            checks = [WitnessCheck.model_validate_json(line) for line in lines]
            by_instance = {check.instance: check for check in checks}
            runs.append(SubmittedRun(path, info, records, by_instance, witnesses))
    except (KeyError, ValidationError) as error:
        raise BadInput(f"{path}: not a submission ({error})") from None
    return runs

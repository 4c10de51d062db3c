"""One instance from its start to a result that can be stored: run, and its witness checked."""

from __future__ import annotations

import os
import platform
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.catalogue import Entry
from harness.checks import check_entry
from harness.limits import DEFAULT
from harness.records import Allowance, Machine, Record, Verdict, WitnessCheck
from harness.runner import Runner
from harness.tool import Tool
from racecar.errors import BadInput

#: With less room than this (bytes) for scratch folders a tool cannot be blamed for anything.
LEAST_ROOM = 1 << 20


@dataclass(frozen=True)
class Setting:
    """What all instances of a run share.

    root: the benchmarks folder, if there is one; limits: those asked for beside wall time.
    """

    tool: Tool
    root: Path | None
    limits: Allowance = DEFAULT

    def runner(self, keep: Sequence[int] = (), cores: Sequence[int] | None = None) -> Runner:
        """Return a new runner."""
        return Runner(self.tool, self.root, keep, cores=cores, limits=self.limits)


@dataclass(frozen=True)
class Result:
    """All that is stored of one instance.

    machine: a description of where it was run, where that is another machine than the harness's.
    """

    record: Record
    log: bytes
    witness: bytes | None = None
    check: WitnessCheck | None = None
    machine: Machine | None = None


def run_job(runner: Runner, entry: Entry) -> Result:
    """Run the tool on an instance and check its witness.

    Raises BadInput where the disk is full after all scratch of the instance was removed: what
    the tool could not write, it could not answer.
    """
    finished = runner.run(entry)
    _require_room()
    record = finished.record.model_copy(update={"host": platform.node()})
    if record.verdict is not Verdict.SAT:
        return Result(record, finished.log)
    witness = finished.witness or b""
    return Result(record, finished.log, witness, check_entry(entry, record, witness))


def _require_room() -> None:
    folder = tempfile.gettempdir()
    state = os.statvfs(folder)
    if state.f_bavail * state.f_frsize < LEAST_ROOM:
        raise BadInput(
            f"{folder}: the disk is full, and tools have no room for scratch; make room (or set "
            "TMPDIR), then go on with --resume"
        )

"""Run one tool on one instance, as VNN-COMP does, and say what came of it.

``prepare_instance.sh``, then ``run_instance.sh``, each a process of its own in one scratch
folder, each under a wall-time limit on its whole process tree.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Self

from harness.answer import Answer, read_answer
from harness.catalogue import Entry, relative, sha256
from harness.files import read_ends
from harness.process_tree import GRACE_S, POLITE_S, Outcome
from harness.records import (
    PREPARE_ERROR,
    PREPARE_TIMEOUT,
    RUN_ERROR,
    RUN_TIMEOUT,
    Limits,
    Record,
    verdict_of,
)
from harness.supervisor import CannotStart, Supervisor, SupervisorLost
from harness.tool import INSTALL, PREPARE, RUN, Tool
from racecar.errors import BadInput

#: Wall-time limits in seconds; VNN-COMP's for prepare_instance.sh.
PREPARE_LIMIT_S, INSTALL_LIMIT_S = 600.0, 3600.0
#: A longer log (bytes) is stored without its middle.
LONGEST_LOG = 1 << 20
#: Exit status of timeout(1), by which VNN-COMP's runner recognises a timeout.
_TIMEOUT_STATUS = 124


class Stopped(Exception):
    """The runner was told to stop; what it was running has no result."""


@dataclass(frozen=True)
class Finished:
    """A result before it is stored: the record, what follows ``sat``, and the log."""

    record: Record
    witness: bytes | None
    log: bytes


class Runner:
    """Runs a tool on instances, one at a time; a context manager.

    keep: file descriptors that stay open until no process of a tool is left; cores: those that
    the tool is pinned to.
    """

    def __init__(
        self,
        tool: Tool,
        root: Path | None,
        keep: Sequence[int] = (),
        *,
        cores: Sequence[int] | None = None,
    ) -> None:
        self.tool, self.root, self._keep, self._cores = tool, root, keep, cores
        self._numbers = count(1)
        self._hashes: dict[Path, str] = {}
        self._stopped, self._lock = False, threading.Lock()
        self._supervisor = Supervisor(keep, cores)

    def install(self) -> tuple[str | None, bytes]:
        """Run install_tool.sh; return what is wrong, if anything, and what it printed."""
        scratch = self._scratch()
        try:
            outcome = self._run(self.tool.command(INSTALL), scratch, INSTALL_LIMIT_S)
            log = read_ends(scratch / "log", LONGEST_LOG)
        except SupervisorLost:
            raise BadInput(
                f"tool {self.tool.name}: {INSTALL} killed the process that keeps its limit"
            ) from None
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        how = None
        if outcome.timed_out:
            how = f"took longer than {INSTALL_LIMIT_S:g} s"
        elif outcome.exit_code:
            how = f"ended with status {outcome.exit_code}"
        return how and f"tool {self.tool.name}: {INSTALL} {how}", log

    def run(self, entry: Entry) -> Finished:
        """Run the tool on an instance."""
        scratch = self._scratch()
        try:
            return self._run_in(scratch, entry)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)

    def _run_in(self, scratch: Path, entry: Entry) -> Finished:
        results = scratch / "result.txt"
        arguments = [entry.category, str(entry.onnx), str(entry.spec)]
        command = self.tool.command(RUN, *arguments, str(results), _plain(entry.timeout))
        onnx_sha256, spec_sha256 = self._sha256(entry.onnx), self._sha256(entry.spec)
        started = datetime.now(UTC).isoformat(timespec="milliseconds")
        prepare = run = _NOTHING
        try:
            prepare = self._run(self.tool.command(PREPARE, *arguments), scratch, PREPARE_LIMIT_S)
            answer = _failed_prepare(prepare)
            if answer is None:
                run = self._run(command, scratch, entry.timeout)
                answer = _answer(run, results, entry.timeout)
            answer = _with_survivors(answer, prepare.survivors + run.survivors)
        except SupervisorLost:
            answer = Answer("error", detail="the process that keeps the limits was killed")
            self._restart()
        if prepare.survivors or run.survivors:
            self._restart()
        record = Record(
            instance=entry.id,
            category=entry.category,
            onnx=relative(entry.onnx, self.root),
            spec=relative(entry.spec, self.root),
            onnx_sha256=onnx_sha256,
            spec_sha256=spec_sha256,
            tool=self.tool.name,
            tool_version=self.tool.version,
            command=command,
            started_at=started,
            prepare_time=prepare.wall_s,
            run_time=run.wall_s,
            cpu_time=run.cpu_s,
            max_memory_mib=run.max_rss_kib / 1024,
            result=answer.result,
            verdict=verdict_of(answer.result),
            detail=answer.detail,
            limits=Limits(
                wall_s=entry.timeout,
                wall_end_s=entry.timeout + GRACE_S,
                wall_kill_s=entry.timeout + GRACE_S + POLITE_S,
                prepare_wall_s=PREPARE_LIMIT_S,
                kept_by=self._supervisor.kept_by,
            ),
            log=f"{entry.id}.log",
        )
        return Finished(record, answer.witness, read_ends(scratch / "log", LONGEST_LOG))

    def _run(self, command: list[str], scratch: Path, limit_s: float) -> Outcome:
        try:
            outcome = self._supervisor.run(
                command, scratch / "work", _environment(scratch), scratch / "log", limit_s
            )
        except CannotStart as error:
            raise BadInput(f"tool {self.tool.name}: cannot be started ({error})") from None
        if self._stopped:  # perhaps the tool ended for that
            raise Stopped
        return outcome

    def _scratch(self) -> Path:
        """Make a scratch folder; short, since sockets below TMPDIR allow about 100 characters."""
        scratch = self._supervisor.scratch / str(next(self._numbers))
        for name in ("work", "tmp"):
            (scratch / name).mkdir(parents=True, exist_ok=True)
        return scratch

    def _sha256(self, path: Path) -> str:
        if path not in self._hashes:
            self._hashes[path] = sha256(path)
        return self._hashes[path]

    def _restart(self) -> None:
        self._supervisor.close()
        with self._lock:
            if self._stopped:
                raise Stopped
            self._supervisor = Supervisor(self._keep, self._cores)

    def stop(self) -> None:
        """End what runs, from another thread: ``run`` raises Stopped, now or when it is called."""
        with self._lock:
            self._stopped = True
            self._supervisor.stop()

    def close(self) -> None:
        """End whatever runs, and remove all scratch folders."""
        self._supervisor.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


_NOTHING = Outcome(0, False, 0.0, 0.0, 0, 0)


def _failed_prepare(outcome: Outcome) -> Answer | None:
    if outcome.timed_out or outcome.exit_code == _TIMEOUT_STATUS:
        return Answer(PREPARE_TIMEOUT)
    if outcome.exit_code:
        return Answer(f"{PREPARE_ERROR}{outcome.exit_code}")
    return None


def _answer(outcome: Outcome, results: Path, timeout: float) -> Answer:
    if outcome.timed_out or outcome.exit_code == _TIMEOUT_STATUS:
        return Answer(RUN_TIMEOUT)
    if outcome.exit_code:
        return Answer(f"{RUN_ERROR}{outcome.exit_code}")
    answer = read_answer(results)
    if outcome.wall_s > timeout:
        return Answer(RUN_TIMEOUT, detail=f"it answered {answer.result}, but after the limit")
    return answer


def _with_survivors(answer: Answer, survivors: int) -> Answer:
    if not survivors:
        return answer
    detail = f"{survivors} processes of the tool could not be killed"
    return replace(answer, detail=f"{answer.detail}; {detail}" if answer.detail else detail)


def _environment(scratch: Path) -> dict[str, str]:
    """Return the environment of a tool's scripts; PYTHON is the harness's own interpreter."""
    return {**os.environ, "PYTHON": sys.executable, "TMPDIR": str(scratch / "tmp")}


def _plain(seconds: float) -> str:
    return str(int(seconds)) if seconds.is_integer() else repr(seconds)

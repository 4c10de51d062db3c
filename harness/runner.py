"""Run one tool on one instance, as VNN-COMP does, and say what came of it.

``prepare_instance.sh``, then ``run_instance.sh``, each a process of its own in one scratch
folder, each under a wall-time limit on its whole process tree.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from harness import landlock
from harness.answer import Answer, read_answer
from harness.bounds import CPU, MEMORY, OUTPUT, SCRATCH, Bounds, Means, Outcome
from harness.catalogue import Entry, relative, sha256
from harness.closing import Closing
from harness.files import read_ends
from harness.limits import DEFAULT, DEFAULT_OUTPUT_MIB, MIB, Allowance, bounds, limits_kept
from harness.place import Place
from harness.process_tree import GRACE_S, POLITE_S
from harness.records import (
    PREPARE_ERROR,
    PREPARE_TIMEOUT,
    RUN_ERROR,
    RUN_TIMEOUT,
    Measured,
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
#: Exit status of a script that was killed, as one is that uses too much of something.
_KILLED_STATUS = 137


class Stopped(Exception):
    """The runner was told to stop; what it was running has no result."""


@dataclass(frozen=True)
class Finished:
    """A result before it is stored: the record, what follows ``sat``, and the log."""

    record: Record
    witness: bytes | None
    log: bytes


class Runner(Closing):
    """Runs a tool on instances, one at a time; a context manager.

    Several at once in one process don't disturb each other. keep: file descriptors that stay open
    until no process of a tool is left; cores: numbers of the cores that the tool is pinned to.
    Raises BadInput for limits that this machine cannot keep.
    """

    def __init__(
        self,
        tool: Tool,
        root: Path | None,
        keep: Sequence[int] = (),
        *,
        cores: Sequence[int] | None = None,
        limits: Allowance = DEFAULT,
    ) -> None:
        _check(limits, cores)
        self.tool, self.root, self._keep = tool, root, keep
        self._cores, self._allowance = cores, limits
        self._hashes: dict[Path, str] = {}
        self._spare: Place | None = None
        self._stopped, self._lock = False, threading.Lock()
        self._supervisor = Supervisor(keep, limits.cgroups)

    def install(self) -> tuple[str | None, bytes]:
        """Run install_tool.sh; return what is wrong, if anything, and what it printed.

        Of the limits only that of wall time and the default one of output hold; HOME is the
        user's own, and anything may be written: what is installed is to stay.
        """
        with self._place() as place:
            limits = bounds(DEFAULT, INSTALL_LIMIT_S, None, str(place.results), str(place.folder))
            try:
                command = self.tool.command(INSTALL)
                outcome = self._run(command, place, place.environment(fresh_home=False), limits)
            except SupervisorLost:
                self._restart()
                raise BadInput(
                    f"tool {self.tool.name}: {INSTALL} killed the process that keeps its limit"
                ) from None
            log = read_ends(place.log, LONGEST_LOG)
        how = None
        if outcome.timed_out:
            how = f"took longer than {INSTALL_LIMIT_S:g} s"
        elif outcome.exceeded is not None:
            how = _too_much(outcome.exceeded, DEFAULT)
        elif outcome.exit_code:
            how = f"ended with status {outcome.exit_code}"
        return how and f"tool {self.tool.name}: {INSTALL} {how}", log

    def run(self, entry: Entry) -> Finished:
        """Run the tool on an instance."""
        with self._place() as place:
            return self._run_in(place, entry)

    def _run_in(self, place: Place, entry: Entry) -> Finished:
        allowance = self._allowance
        arguments = [entry.category, str(entry.onnx), str(entry.spec)]
        prepare_command = self.tool.command(PREPARE, *arguments)
        command = self.tool.command(RUN, *arguments, str(place.results), _plain(entry.timeout))
        onnx_sha256, spec_sha256 = self._sha256(entry.onnx), self._sha256(entry.spec)
        environment = place.environment(allowance.fresh_home)

        def limited(wall_s: float, cpu: bool) -> Bounds:
            folder, results = str(place.folder), str(place.results)
            return bounds(allowance, wall_s, self._cores, results, folder, cpu)

        started = datetime.now(UTC).isoformat(timespec="milliseconds")
        prepare = run = _NOTHING
        lost = False
        try:
            to_prepare = limited(PREPARE_LIMIT_S, cpu=False)
            prepare = self._run(prepare_command, place, environment, to_prepare)
            answer = _failed_prepare(prepare, allowance)
            if answer is None:
                run = self._run(command, place, environment, limited(entry.timeout, cpu=True))
                answer = _answer(run, place.results, entry.timeout, allowance)
            answer = _with_survivors(answer, prepare.survivors + run.survivors)
        except SupervisorLost:
            answer = Answer("error", detail="the process that keeps the limits was killed")
            lost = True
        log = read_ends(place.log, LONGEST_LOG)
        if lost or prepare.survivors or run.survivors:
            self._restart()
        means = (prepare if run is _NOTHING else run).means
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
            max_memory_mib=run.max_memory / MIB,
            measured_by=Measured(cpu_time=run.means.cpu, max_memory=run.means.memory),
            result=answer.result,
            verdict=verdict_of(answer.result),
            detail=answer.detail,
            limits=limits_kept(
                allowance,
                self._cores,
                means,
                wall_s=entry.timeout,
                wall_end_s=entry.timeout + GRACE_S,
                wall_kill_s=entry.timeout + GRACE_S + POLITE_S,
                prepare_wall_s=PREPARE_LIMIT_S,
            ),
            log=f"{entry.id}.log",
        )
        return Finished(record, answer.witness, log)

    def _run(
        self, command: list[str], place: Place, environment: dict[str, str], limits: Bounds
    ) -> Outcome:
        place.restore()
        try:
            outcome = self._supervisor.run(command, place.work, environment, place.log, limits)
        except CannotStart as error:
            raise BadInput(f"tool {self.tool.name}: cannot be started ({error})") from None
        if self._stopped:  # perhaps the tool ended for that
            raise Stopped
        return outcome

    @contextmanager
    def _place(self) -> Iterator[Place]:
        """Lend a place that is as good as new; one that was left so is used again."""
        place, self._spare = self._spare or Place(self._supervisor.scratch), None
        try:
            yield place
        finally:
            if place.clear():
                self._spare = place

    def _sha256(self, path: Path) -> str:
        if path not in self._hashes:
            self._hashes[path] = sha256(path)
        return self._hashes[path]

    def _restart(self) -> None:
        self._supervisor.close()
        with self._lock:
            if self._stopped:
                raise Stopped
            self._supervisor = Supervisor(self._keep, self._allowance.cgroups)

    def stop(self) -> None:
        """End what runs, from another thread: ``run`` raises Stopped, now or when it is called."""
        with self._lock:
            self._stopped = True
            self._supervisor.stop()

    def close(self) -> None:
        """End whatever runs, and remove all scratch folders."""
        self._supervisor.close()


_NOTHING = Outcome(0, None, 0.0, 0.0, 0, 0, Means())


def _check(limits: Allowance, cores: Sequence[int] | None) -> None:
    """Refuse what this machine cannot do at all."""
    if limits.contain and not landlock.can_forbid_writes():
        raise BadInput(
            "--contain: this system cannot keep a tool in its scratch folder (it takes Linux 6.2 "
            "with Landlock); leave the option out, or run in a container"
        )
    if cores is None:
        return
    usable = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    if not cores or (usable is not None and not set(cores) <= usable):
        raise BadInput(
            f"cores {', '.join(map(str, cores)) or '(none)'}: usable are "
            f"{', '.join(map(str, sorted(usable or ())))}"
        )


def _failed_prepare(outcome: Outcome, allowance: Allowance) -> Answer | None:
    if outcome.timed_out or outcome.exit_code == _TIMEOUT_STATUS:
        return Answer(PREPARE_TIMEOUT)
    if outcome.exceeded is not None:
        detail = f"{PREPARE} {_too_much(outcome.exceeded, allowance)}"
        return Answer(f"{PREPARE_ERROR}{_KILLED_STATUS}", detail=detail)
    if outcome.exit_code:
        return Answer(f"{PREPARE_ERROR}{outcome.exit_code}")
    return None


def _answer(outcome: Outcome, results: Path, timeout: float, allowance: Allowance) -> Answer:
    """Return the answer; what became too much decides, whatever the tool wrote or ended with."""
    if outcome.timed_out:
        return Answer(RUN_TIMEOUT)
    if outcome.exceeded is not None:
        code = RUN_TIMEOUT if outcome.exceeded == CPU else f"{RUN_ERROR}{_KILLED_STATUS}"
        return Answer(code, detail=f"it {_too_much(outcome.exceeded, allowance)}")
    if outcome.exit_code == _TIMEOUT_STATUS:
        return Answer(RUN_TIMEOUT)
    if outcome.exit_code:
        return Answer(f"{RUN_ERROR}{outcome.exit_code}")
    answer = read_answer(results)
    if outcome.wall_s > timeout:
        return Answer(RUN_TIMEOUT, detail=f"it answered {answer.result}, but after the limit")
    return answer


def _too_much(what: str, allowance: Allowance) -> str:
    limit = {
        CPU: f"{allowance.cpu_s:g} s" if allowance.cpu_s else "",
        MEMORY: f"{allowance.memory_mib:g} MiB" if allowance.memory_mib else "",
        OUTPUT: f"{allowance.output_mib or DEFAULT_OUTPUT_MIB:g} MiB",
        SCRATCH: f"{allowance.scratch_mib:g} MiB" if allowance.scratch_mib else "",
    }[what]
    of = {
        CPU: "of CPU time",
        MEMORY: "of memory",
        OUTPUT: "of printed output, or of the result file",
        SCRATCH: "in its scratch folder",
    }[what]
    return f"used more than the limit of {limit} {of}"


def _with_survivors(answer: Answer, survivors: int) -> Answer:
    if not survivors:
        return answer
    detail = f"{survivors} processes of the tool could not be killed"
    return replace(answer, detail=f"{answer.detail}; {detail}" if answer.detail else detail)


def _plain(seconds: float) -> str:
    return str(int(seconds)) if seconds.is_integer() else repr(seconds)

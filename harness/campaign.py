"""A whole run: a tool on many instances, stored one by one, continued where it ended."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from harness.catalogue import Entry, sha256
from harness.cores import share_out, usable_cores
from harness.export import results_csv
from harness.files import write_durable
from harness.job import Result, Setting
from harness.limits import DEFAULT, OPTIONS
from harness.local import LocalJobs
from harness.machine import describe_machine, package_version
from harness.records import Allowance, Machine, Record, RunInfo, WitnessCheck
from harness.store import RunFolder
from harness.tool import Tool
from racecar.errors import BadInput

#: Called before an instance is run, perhaps from other threads, and after it was stored.
OnStart = Callable[[Entry], None]
OnResult = Callable[[Record, WitnessCheck | None], None]
#: Called with news for the person who waits: a few words.
OnNote = Callable[[str], None]


@dataclass(frozen=True)
class Plan:
    """What a run is to do.

    root: the benchmarks folder, where there is one; timeout: of every instance, in seconds,
    instead of its own; jobs: how many run at a time; cores_per_job: how many cores each is
    pinned to, default as many as there are for each; scheduler: the address of the Dask
    scheduler on whose workers they run, instead of here; limits: those asked for beside wall time.
    """

    tool: Tool
    entries: Sequence[Entry]
    root: Path | None
    out: Path
    resume: bool = False
    timeout: float | None = None
    install: bool = True
    jobs: int = 1
    cores_per_job: int | None = None
    scheduler: str | None = None
    limits: Allowance = DEFAULT


class Jobs(Protocol):
    """What runs instances, here or elsewhere; a context manager that ends whatever runs."""

    def install(self) -> tuple[str | None, bytes]:
        """Run install_tool.sh; return what is wrong, if anything, and what it printed."""

    def results(self, entries: Sequence[Entry], on_start: OnStart) -> Iterator[Result]:
        """Run instances; yield their results, one each, as they come."""

    def stop(self) -> list[Result]:
        """End all tools; return results that had come in and were not read."""


def execute(plan: Plan, on_start: OnStart, on_result: OnResult, on_note: OnNote) -> None:
    """Run what has no record yet. BadInput for a plan that can't be."""
    places = _places(plan)
    if plan.scheduler is not None and not plan.out.exists():
        # So that nothing is begun where there is no scheduler.
        from harness.cluster import connect  # noqa: PLC0415

        connect(plan.scheduler).close()
    if plan.resume and plan.out.exists():
        folder = RunFolder.open(plan.out)
    else:
        folder = RunFolder.create(plan.out)
    with folder, _held(folder.lock()) as lock:
        if folder.has_begun():
            _check_same(plan, folder.info())
        else:
            folder.write_info(_describe(plan))
        todo = _to_do(plan, folder)
        if todo:
            with _make_jobs(plan, places, lock, on_note) as jobs:
                _run_all(plan, folder, jobs, todo, on_start, on_result)
        write_durable(folder.path / "results.csv", results_csv(folder.records()))
        folder.finish()


def _places(plan: Plan) -> list[Sequence[int] | None]:
    """Return the cores of each job that runs here at the same time."""
    if plan.scheduler is not None:
        return []
    if plan.jobs == 1 and plan.cores_per_job is None:
        return [None]
    return [*share_out(plan.jobs, plan.cores_per_job, usable_cores())]


@contextmanager
def _held(lock: int) -> Iterator[int]:
    try:
        yield lock
    finally:
        os.close(lock)


def _to_do(plan: Plan, folder: RunFolder) -> list[Entry]:
    """Return the instances that have no record; BadInput if one was changed since it was run."""
    stored = {record.instance: record for record in folder.records()}
    hashes: dict[Path, str] = {}
    todo = []
    for entry in plan.entries:
        record = stored.get(entry.id)
        if record is None:
            todo.append(replace(entry, timeout=plan.timeout or entry.timeout))
            continue
        for path, known in ((entry.spec, record.spec_sha256), (entry.onnx, record.onnx_sha256)):
            if path not in hashes:
                hashes[path] = sha256(path)
            if hashes[path] != known:
                raise BadInput(
                    f"{folder.path}: its result of {entry.id} is that of another version of "
                    f"{path}; start a new run with --out"
                )
    return todo


def _make_jobs(
    plan: Plan, places: Sequence[Sequence[int] | None], lock: int, on_note: OnNote
) -> AbstractContextManager[Jobs]:
    setting = Setting(plan.tool, plan.root, plan.limits)
    if plan.scheduler is None:
        # The lock goes to the runners' helpers too: it ends when no process of a tool is left.
        return LocalJobs(setting, places, keep=(lock,))
    # Slow to import, and an extra.
    from harness.cluster import ClusterJobs  # noqa: PLC0415

    return ClusterJobs(setting, plan.scheduler, plan.cores_per_job, on_note)


def _run_all(
    plan: Plan,
    folder: RunFolder,
    jobs: Jobs,
    todo: Sequence[Entry],
    on_start: OnStart,
    on_result: OnResult,
) -> None:
    if plan.install and plan.tool.has_install and not folder.is_installed():
        failure, log = jobs.install()
        folder.add_install(failure, log)
        if failure:
            raise BadInput(f"{failure}; harness log {folder.path} shows what it printed")

    def store(result: Result) -> None:
        if result.machine is not None:
            _store_machine(folder, result.record.host, result.machine)
        record = folder.add(
            result.record, log=result.log, witness=result.witness, check=result.check
        )
        on_result(record, result.check)

    try:
        for result in jobs.results(todo, on_start):
            store(result)
    except KeyboardInterrupt:
        for result in jobs.stop():
            store(result)
        raise


def _store_machine(folder: RunFolder, host: str | None, machine: Machine) -> None:
    info = folder.info()
    if host is not None and info.workers.get(host) != machine:
        workers = {**info.workers, host: machine}
        folder.write_info(info.model_copy(update={"workers": workers}))


def _describe(plan: Plan) -> RunInfo:
    return RunInfo(
        tool=plan.tool.info(),
        benchmarks=str(plan.root) if plan.root else None,
        timeout_s=plan.timeout,
        limits=plan.limits,
        created_at=datetime.now(UTC).isoformat(timespec="seconds"),
        harness_version=package_version("closedlap"),
        machine=describe_machine(),
    )


def _check_same(plan: Plan, before: RunInfo) -> None:
    """Refuse to continue a run with something else."""
    now = plan.tool.info()
    for what, old, new in (
        ("tool", before.tool.name, now.name),
        ("tool version", before.tool.version, now.version),
        ("tool (its scripts changed)", before.tool.scripts_sha256, now.scripts_sha256),
        ("--timeout", before.timeout_s, plan.timeout),
        *(
            (option, getattr(before.limits, name), getattr(plan.limits, name))
            for name, option in OPTIONS.items()
        ),
    ):
        if old != new:
            raise BadInput(
                f"{plan.out}: it was begun with another {what} ({old}, now {new}); "
                "start a new run with --out"
            )

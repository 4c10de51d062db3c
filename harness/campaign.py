"""A whole run: a tool on many instances, stored one by one, continued where it ended."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from harness.catalogue import Entry, sha256
from harness.checks import check_entry
from harness.export import results_csv
from harness.files import write_durable
from harness.limits import DEFAULT, Allowance
from harness.machine import describe_machine, package_version
from harness.records import Record, RunInfo, Verdict, WitnessCheck
from harness.runner import Finished, Runner
from harness.store import RunFolder
from harness.tool import Tool
from racecar.errors import BadInput

#: Called before an instance is run, and after it was stored.
OnStart = Callable[[Entry], None]
OnResult = Callable[[Record, WitnessCheck | None], None]


@dataclass(frozen=True)
class Plan:
    """What a run is to do.

    root: the benchmarks folder, where there is one; timeout: of every instance, in seconds,
    instead of its own.
    """

    tool: Tool
    entries: Sequence[Entry]
    root: Path | None
    out: Path
    resume: bool = False
    timeout: float | None = None
    install: bool = True
    limits: Allowance = DEFAULT


def execute(plan: Plan, on_start: OnStart, on_result: OnResult) -> RunFolder:
    """Run what has no record yet; return the run folder. BadInput for a plan that can't be."""
    if plan.resume and plan.out.exists():
        folder = RunFolder.open(plan.out)
    else:
        folder = RunFolder.create(plan.out)
    lock = folder.lock()
    try:
        if folder.info_path.exists():
            _check_same(plan, folder.info())
        else:
            folder.write_info(_describe(plan))
        _run_all(plan, folder, lock, on_start, on_result)
        write_durable(folder.path / "results.csv", results_csv(folder.records()))
    finally:
        os.close(lock)
    return folder


def _run_all(
    plan: Plan, folder: RunFolder, lock: int, on_start: OnStart, on_result: OnResult
) -> None:
    todo = []
    for entry in plan.entries:
        entry = replace(entry, timeout=plan.timeout or entry.timeout)  # noqa: PLW2901
        if folder.record_path(entry.id).exists():
            _check_current(folder.record(entry.id), entry, folder)
        else:
            todo.append(entry)
    if not todo:
        return
    # The lock goes to the runner's helper too: it ends when no process of a tool is left.
    with Runner(plan.tool, plan.root, keep=(lock,), limits=plan.limits) as runner:
        installed = folder.path / "logs" / "install_tool.log"
        if plan.install and plan.tool.has_install and not installed.exists():
            failure, log = runner.install()
            name = "install_tool.failed.log" if failure else installed.name
            write_durable(installed.with_name(name), log)
            if failure:
                raise BadInput(f"{failure}; its output is in {installed.with_name(name)}")
        for entry in todo:
            on_start(entry)
            on_result(*_store(folder, entry, runner.run(entry)))


def _store(folder: RunFolder, entry: Entry, result: Finished) -> tuple[Record, WitnessCheck | None]:
    """Store a result; the record comes last and stands for all the rest."""
    record, check = result.record, None
    if record.verdict is Verdict.SAT:
        witness = result.witness or b""
        check = check_entry(entry, record, witness)
        name = folder.write_witness(record.instance, witness)
        record = record.model_copy(update={"witness": name})
        folder.write_check(check)
    folder.write_log(record.log, result.log)
    folder.write_record(record)
    return record, check


def _describe(plan: Plan) -> RunInfo:
    return RunInfo(
        tool=plan.tool.info(),
        benchmarks=str(plan.root) if plan.root else None,
        timeout_s=plan.timeout,
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
    ):
        if old != new:
            raise BadInput(
                f"{plan.out}: it was begun with another {what} ({old}, now {new}); "
                "start a new run with --out"
            )


def _check_current(record: Record, entry: Entry, folder: RunFolder) -> None:
    if record.spec_sha256 != sha256(entry.spec) or record.onnx_sha256 != sha256(entry.onnx):
        raise BadInput(
            f"{folder.record_path(entry.id)}: it is the result of another version of "
            f"{entry.spec} or its controller; start a new run with --out"
        )

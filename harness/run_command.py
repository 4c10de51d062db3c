"""``harness run``: a tool on instances, its witnesses checked, the score printed."""

# ruff: noqa: PLC0415 (imported when the command runs, so that no other command waits)

from __future__ import annotations

import math
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from harness.command_options import as_path, benchmarks_option, json_option
from harness.limit_options import limit_options
from racecar.command_line import print_json
from racecar.errors import BadInput

if TYPE_CHECKING:
    from harness.records import Allowance


@click.command("run")
@click.option("--tool", required=True, help="A tool that ships, or a folder with its scripts.")
@click.option("--category", "categories", multiple=True, help="A category; may be repeated.")
@click.option("--instance", "instances", multiple=True, help="An instance file, or an ID.")
@click.option("--out", type=as_path, help="Run folder; default: runs/TOOL-DATE-TIME.")
@click.option("--resume", is_flag=True, help="Continue the run in --out.")
@click.option(
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    metavar="S",
    help="Seconds for every instance, instead of its own timeout.",
)
@click.option("--name", help="Name of the tool in the results; default: its folder's.")
@click.option(
    "--jobs",
    type=click.IntRange(1),
    metavar="N",
    help="Run N instances at a time, each pinned to its share of the cores; default: 1.",
)
@click.option(
    "--cores-per-job",
    type=click.IntRange(1),
    metavar="K",
    help="Pin each job to K cores, instead of as many as there are for each.",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Run on the workers of this Dask scheduler, as tcp://HOST:8786 (docs/clusters.md).",
)
@limit_options
@click.option("--no-install", is_flag=True, help="Don't run the tool's install_tool.sh.")
@benchmarks_option
@json_option
def run_command(
    tool: str,
    categories: tuple[str, ...],
    instances: tuple[str, ...],
    out: Path | None,
    resume: bool,
    timeout: float | None,
    name: str | None,
    jobs: int | None,
    cores_per_job: int | None,
    scheduler: str | None,
    limits: Allowance,
    no_install: bool,
    benchmarks: Path | None,
    as_json: bool,
) -> int:
    """Run a tool on instances, check its witnesses, print results and score.

    Without --category and --instance it runs on everything in the benchmarks folder. Interrupted
    or killed, it goes on with --resume.
    """
    from harness import report
    from harness.campaign import Plan, execute
    from harness.catalogue import find_root, require_root, select
    from harness.checks import witness_check
    from harness.score_command import print_score
    from harness.store import DATABASE, RunFolder
    from harness.tool import find_tool

    if resume and out is None:
        raise BadInput("--resume: say with --out which run to continue")
    if timeout is not None and not math.isfinite(timeout):
        raise BadInput("--timeout: it must be a number of seconds")
    found = find_tool(tool, name)
    root = find_root(benchmarks) if instances and not categories else require_root(benchmarks)
    entries = select(root, categories, instances)
    if out is None:
        out = Path("runs") / f"{found.name}-{datetime.now():%Y%m%d-%H%M%S}"
    if scheduler is not None and jobs is not None:
        raise BadInput("--jobs: with --scheduler the workers say how many run at a time")
    plan = Plan(
        tool=found,
        entries=entries,
        root=root,
        out=out,
        resume=resume,
        timeout=timeout,
        install=not no_install,
        jobs=jobs or 1,
        cores_per_job=cores_per_job,
        scheduler=scheduler,
        limits=limits,
    )
    with RunFolder(out) as run:
        stored = len(run.instances() & {entry.id for entry in entries})
    bar = report.ProgressBar(len(entries), stored, as_json)
    seen: set[str] = set()

    def on_result(record: Any, check: Any) -> None:
        bar.end(record.instance)
        seen.add(record.instance)
        if as_json:
            print_json(_result_data(record, check))

    try:
        with _sigterm_interrupts(), bar:
            execute(plan, lambda entry: bar.begin(entry.id), on_result, bar.note)
    except KeyboardInterrupt:
        if (out / DATABASE).exists():
            click.echo(f"to go on: harness {shlex.join(_again(out))}", err=True)
        raise
    wanted = {entry.id for entry in entries}
    with RunFolder.open(out) as run:
        results = [
            (record, witness_check(run, record, root))
            for record in run.records()
            if record.instance in wanted
        ]
    if as_json:
        for record, check in results:
            if record.instance not in seen:
                print_json(_result_data(record, check))
    else:
        report.print_results(results)
    return print_score([out], root, not as_json, as_json=False)


@contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """Let SIGTERM, with which batch systems end a job, end the run as Ctrl-C does."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _again(out: Path) -> list[str]:
    """Return the arguments that continue this run."""
    again = [argument for argument in sys.argv[1:] if argument != "--resume"]
    if not any(argument == "--out" or argument.startswith("--out=") for argument in again):
        again += ["--out", str(out)]
    return [*again, "--resume"]


def _result_data(record: Any, check: Any) -> dict[str, Any]:
    data = record.model_dump(mode="json")
    return {**data, "witness_check": check.model_dump(mode="json") if check else None}

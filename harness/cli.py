"""The command ``harness``: run tools on instances, replay witnesses, score runs.

Every command imports what it needs, so that none waits for what another needs.
"""

# ruff: noqa: PLC0415

from __future__ import annotations

import math
import shlex
import signal
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import click

from harness.command_options import as_path, benchmarks_option, json_option
from harness.replay_command import replay_command
from harness.score_command import print_score, score_command
from harness.submit_command import submit_command, verify_command
from racecar.command_line import DONE, Commands, print_json
from racecar.errors import BadInput


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Run verifiers on instances and judge what they answer."""


for command in (replay_command, score_command, submit_command, verify_command):
    main.add_command(command)


@main.command("run")
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
    no_install: bool,
    benchmarks: Path | None,
    as_json: bool,
) -> int:
    """Run a tool on instances, check its witnesses, print results and score.

    Without --category and --instance it runs on everything in the benchmarks folder.
    """
    from harness import report
    from harness.campaign import Plan, execute
    from harness.catalogue import find_root, require_root, select
    from harness.checks import witness_check
    from harness.store import RunFolder
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
    plan = Plan(found, entries, root, out, resume, timeout, not no_install)
    # Schedulers end a job with SIGTERM; it ends the run as Ctrl-C does.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    stored = sum(RunFolder(out).record_path(entry.id).exists() for entry in entries)
    bar = report.ProgressBar(len(entries), stored, as_json)
    seen: set[str] = set()

    def on_result(record: Any, check: Any) -> None:
        bar.advance()
        seen.add(record.instance)
        if as_json:
            print_json(_result_data(record, check))

    try:
        with bar:
            folder = execute(plan, lambda entry: bar.begin(entry.id), on_result)
    except KeyboardInterrupt:
        if (out / "run.json").exists():
            again = [arg for arg in sys.argv[1:] if arg != "--resume"]
            if not any(arg == "--out" or arg.startswith("--out=") for arg in again):
                again += ["--out", str(out)]
            click.echo(f"to go on: harness {shlex.join([*again, '--resume'])}", err=True)
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
    wanted = {entry.id for entry in entries}
    results = [
        (record, witness_check(folder, record, root))
        for record in folder.records()
        if record.instance in wanted
    ]
    if as_json:
        for record, check in results:
            if record.instance not in seen:
                print_json(_result_data(record, check))
    else:
        report.print_results(results)
    return print_score([folder.path], root, not as_json, as_json=False)


def _result_data(record: Any, check: Any) -> dict[str, Any]:
    data = record.model_dump(mode="json")
    return {**data, "witness_check": check.model_dump(mode="json") if check else None}


@main.command("export")
@click.argument("run", type=as_path)
@click.option("--layout", type=click.Choice(["csv"]), default="csv", show_default=True)
@click.option("-o", "--output", type=as_path, required=True, metavar="FILE")
def export_command(run: Path, layout: str, output: Path) -> int:
    """Write a run's results as VNN-COMP's six columns, no header."""
    from harness.export import results_csv
    from harness.store import RunFolder
    from racecar.controller import write_whole

    assert layout == "csv"
    if output.is_dir():
        raise BadInput(f"{output}: it is a folder; give a file")
    write_whole(output, results_csv(RunFolder.open(run).records()))
    return DONE

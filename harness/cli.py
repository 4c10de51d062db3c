"""The command ``harness``: run tools on instances, replay witnesses, score runs.

Every command imports what it needs, so that none waits for what another needs.
"""

# ruff: noqa: PLC0415

from __future__ import annotations

import math
import shlex
import signal
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from harness.limit_options import limit_options
from racecar.command_line import CHECK_FAILED, DONE, Commands, print_json
from racecar.errors import BadInput

if TYPE_CHECKING:
    from harness.limits import Allowance

_as_path = click.Path(path_type=Path)


def _json_option(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object a result.")(
        command
    )


def _benchmarks_option(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.option(
        "--benchmarks",
        type=_as_path,
        metavar="DIR",
        help="Benchmarks folder; default: ./benchmarks, else the one beside the harness.",
    )(command)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Run verifiers on closed-loop instances and judge what they answer."""


@main.command("run")
@click.option("--tool", required=True, help="A tool that ships, or a folder with its scripts.")
@click.option("--category", "categories", multiple=True, help="A category; may be repeated.")
@click.option("--instance", "instances", multiple=True, help="An instance file, or an ID.")
@click.option("--out", type=_as_path, help="Run folder; default: runs/TOOL-DATE-TIME.")
@click.option("--resume", is_flag=True, help="Continue the run in --out.")
@click.option(
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    metavar="S",
    help="Seconds for every instance, instead of its own timeout.",
)
@click.option("--name", help="Name of the tool in the results; default: its folder's.")
@limit_options
@click.option("--no-install", is_flag=True, help="Don't run the tool's install_tool.sh.")
@_benchmarks_option
@_json_option
def run_command(
    tool: str,
    categories: tuple[str, ...],
    instances: tuple[str, ...],
    out: Path | None,
    resume: bool,
    timeout: float | None,
    name: str | None,
    limits: Allowance,
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
    plan = Plan(found, entries, root, out, resume, timeout, not no_install, limits)
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
    return _score([folder.path], root, not as_json, as_json=False)


def _result_data(record: Any, check: Any) -> dict[str, Any]:
    data = record.model_dump(mode="json")
    return {**data, "witness_check": check.model_dump(mode="json") if check else None}


def _score(
    runs: list[Path], root: Path | None, table: bool, as_json: bool, recheck: bool = False
) -> int:
    from harness import report
    from harness.evidence import gather
    from harness.scoring import score
    from harness.store import RunFolder

    evidence = gather([RunFolder.open(path) for path in runs], root, recheck)
    scores = score(evidence.claims, evidence.references)
    for note in evidence.notes:
        click.echo(f"note: {note}", err=True)
    if as_json:
        for row in scores.rows:
            print_json(report.row_data(row, scores.contradictions))
    if table:
        report.print_scores(scores)
    else:
        report.print_contradictions(scores.contradictions, stderr=True)
    return CHECK_FAILED if scores.reference_refuted else DONE


@main.command("score")
@click.argument("runs", nargs=-1, required=True, type=_as_path, metavar="RUN...")
@click.option("--recheck", is_flag=True, help="Replay every witness again.")
@_benchmarks_option
@_json_option
def score_command(
    runs: tuple[Path, ...], recheck: bool, benchmarks: Path | None, as_json: bool
) -> int:
    """Score runs by VNN-COMP's rules.

    Ends with status 1 if a witness refutes a reference result.
    """
    from harness.catalogue import find_root

    unique = list({path.resolve(): path for path in runs}.values())
    root = find_root(benchmarks) or _named_by(unique[0])
    return _score(unique, root, not as_json, as_json, recheck)


def _named_by(run: Path) -> Path | None:
    """Return the benchmarks folder that a run was made with, if it is still there."""
    from harness.store import RunFolder

    folder = RunFolder.open(run).info().benchmarks
    return Path(folder) if folder and Path(folder).is_dir() else None


@main.command("replay")
@click.argument("instance", type=_as_path)
@click.argument("witness", type=_as_path)
@_json_option
def replay_command(instance: Path, witness: Path, as_json: bool) -> int:
    """Check a witness independently of every tool.

    WITNESS is a JSON file with s, f, v and theta, or a result file: sat, then the JSON. Ends with
    status 0 if a tool is credited for it, 1 if not.
    """
    from harness import report
    from harness.replay import check_file

    check = check_file(instance, witness)
    if as_json:
        data = check.model_dump(mode="json")
        flags = {"credited": check.credited, "establishes_sat": check.establishes_sat}
        print_json({**data, **flags})
    else:
        report.print_check(check)
    return DONE if check.credited else CHECK_FAILED


@main.command("export")
@click.argument("run", type=_as_path)
@click.option("--layout", type=click.Choice(["csv"]), default="csv", show_default=True)
@click.option("-o", "--output", type=_as_path, required=True, metavar="FILE")
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

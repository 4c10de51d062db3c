"""The command ``harness``: run tools on instances, replay witnesses, score runs.

Every command imports what it needs, so that none waits for what another needs.
"""

# ruff: noqa: PLC0415

from __future__ import annotations

from pathlib import Path

import click

from harness.command_options import as_path, benchmarks_option, json_option
from harness.log_command import log_command
from harness.run_command import run_command
from racecar.command_line import CHECK_FAILED, DONE, Commands, print_json
from racecar.errors import BadInput


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Run verifiers on closed-loop instances and judge what they answer."""


main.add_command(run_command)
main.add_command(log_command)


def print_score(
    runs: list[Path], root: Path | None, table: bool, as_json: bool, recheck: bool = False
) -> int:
    """Score runs and print rows, as a table or as JSON; return the exit status."""
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
@click.argument("runs", nargs=-1, required=True, type=as_path, metavar="RUN...")
@click.option("--recheck", is_flag=True, help="Replay every witness again.")
@benchmarks_option
@json_option
def score_command(
    runs: tuple[Path, ...], recheck: bool, benchmarks: Path | None, as_json: bool
) -> int:
    """Score runs by VNN-COMP's rules.

    Ends with status 1 if a witness refutes a reference result.
    """
    from harness.catalogue import find_root

    unique = list({path.resolve(): path for path in runs}.values())
    root = find_root(benchmarks) or _named_by(unique[0])
    return print_score(unique, root, not as_json, as_json, recheck)


def _named_by(run: Path) -> Path | None:
    """Return the benchmarks folder that a run was made with, if it is still there."""
    from harness.store import RunFolder

    folder = RunFolder.open(run).info().benchmarks
    return Path(folder) if folder and Path(folder).is_dir() else None


@main.command("replay")
@click.argument("instance", type=as_path)
@click.argument("witness", type=as_path)
@json_option
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

"""``harness score``: runs side by side, by VNN-COMP's rules."""

# ruff: noqa: PLC0415 (imported when the command runs, so that no other command waits)

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from harness.command_options import as_path, benchmarks_option, json_option
from racecar.command_line import CHECK_FAILED, DONE, print_json


@click.command("score")
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


def print_score(
    runs: Sequence[Path], root: Path | None, table: bool, as_json: bool, recheck: bool = False
) -> int:
    """Score runs, print a table or JSON or neither, and return the exit status."""
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


def _named_by(run: Path) -> Path | None:
    """Return the benchmarks folder that a run was made with, if it is still there."""
    from harness.store import RunFolder

    folder = RunFolder.open(run).info().benchmarks
    return Path(folder) if folder and Path(folder).is_dir() else None

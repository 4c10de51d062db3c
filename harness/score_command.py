"""``harness score``: runs side by side, by VNN-COMP's rules."""

# ruff: noqa: PLC0415 (imported when the command runs, so that no other command waits)

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from harness.command_options import as_path, benchmarks_option, json_option
from racecar.command_line import CHECK_FAILED, DONE, print_json

if TYPE_CHECKING:
    from harness.evidence import Evidence
    from harness.scoring import Scores


@click.command("score")
@click.argument("runs", nargs=-1, required=True, type=as_path, metavar="RUN...")
@click.option("--recheck", is_flag=True, help="Replay every witness again.")
@click.option("--explain", metavar="INSTANCE", help="Say why each result of it got its points.")
@benchmarks_option
@json_option
def score_command(
    runs: tuple[Path, ...],
    recheck: bool,
    explain: str | None,
    benchmarks: Path | None,
    as_json: bool,
) -> int:
    """Score runs by VNN-COMP's rules.

    RUN is a run folder, or the file of a submission, which is verified first. Ends with status 1
    if a witness refutes a reference result.
    """
    from harness.catalogue import find_root

    unique = list({path.resolve(): path for path in runs}.values())
    folders = [path for path in unique if not path.is_file()]
    root = find_root(benchmarks) or (_named_by(folders[0]) if folders else None)
    if explain is not None:
        return _explain(explain, unique, root, as_json, recheck)
    return print_score(unique, root, not as_json, as_json, recheck)


def print_score(
    runs: Sequence[Path], root: Path | None, table: bool, as_json: bool, recheck: bool = False
) -> int:
    """Score runs, print a table or JSON or neither, and return the exit status."""
    from harness import report

    _, scores = _scored(runs, root, recheck)
    if as_json:
        for row in scores.rows:
            print_json(report.row_data(row, scores))
    if table:
        report.print_scores(scores)
    else:
        report.print_contradictions(scores, stderr=True)
    return CHECK_FAILED if scores.reference_refuted else DONE


def _explain(
    instance: str, runs: Sequence[Path], root: Path | None, as_json: bool, recheck: bool
) -> int:
    from harness import report
    from harness.explain import explain

    evidence, scores = _scored(runs, root, recheck)
    reference, explanations = explain(instance, evidence, scores)
    if as_json:
        for explanation in explanations:
            print_json(report.explanation_data(explanation, reference))
    else:
        found = [c for c in scores.contradictions if c.instance == instance]
        report.print_explanations(instance, reference, explanations, found)
    return CHECK_FAILED if scores.reference_refuted else DONE


def _scored(runs: Sequence[Path], root: Path | None, recheck: bool) -> tuple[Evidence, Scores]:
    from harness.evidence import gather
    from harness.scoring import score
    from harness.store import RunFolder
    from harness.submission.source import open_submission

    sources = [
        open_submission(path, root) if path.is_file() else RunFolder.open(path) for path in runs
    ]
    evidence = gather(sources, root, recheck)
    for note in evidence.notes:
        click.echo(f"note: {note}", err=True)
    return evidence, score(evidence.claims, evidence.references)


def _named_by(run: Path) -> Path | None:
    """Return the benchmarks folder that a run was made with, if it is still there."""
    from harness.store import RunFolder

    folder = RunFolder.open(run).info().benchmarks
    return Path(folder) if folder and Path(folder).is_dir() else None

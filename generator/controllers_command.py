"""The command ``generator controllers``: the table of the trained controllers."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from generator.command_options import root_option
from generator.controllers_table import (
    RUNS,
    TABLE,
    Row,
    Runs,
    drive,
    format_table,
    known_rows,
    load_all,
    make_row,
    read_measured,
)
from generator.emit import MANIFEST, all_folders
from generator.progress import progress_bar
from generator.published import load_published
from generator.tree import refresh_manifest, update_file
from racecar.command_line import print_json


@click.command()
@click.argument("names", nargs=-1)
@root_option
@click.option(
    "--runs", type=click.IntRange(1), default=RUNS, show_default=True, help="Of each, with faults."
)
@click.option("--write", is_flag=True, help=f"Bring ROOT/{TABLE} up to date, too.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per controller.")
def controllers(names: tuple[str, ...], root: Path, runs: int, write: bool, as_json: bool) -> None:
    """Tell of the trained controllers NAMES in ROOT/onnx, or of all, how they came out.

    Which seeds were tried and which of them finished the turn, the training's return and time,
    margin and smoothness without faults, and the share of runs that are safe under the paper's
    faults. Runs that the table in ROOT/benchmarks/controllers.csv has of the same network are
    not made again.
    """
    published = load_all(root)
    chosen = [load_published(root, name) for name in names] or published
    measured, rows = read_measured(root), []
    with progress_bar(as_json) as report:
        for file, record in chosen:
            known = measured.get(file.sha256)
            # What is wrong with its files is said before its runs are made.
            make_row(file, record, known or Runs(runs, 0))
            if known is None or known.count != runs:
                measured[file.sha256] = drive(file, runs, partial(report, file.name))
                if write:  # whoever stops it loses one controller's runs
                    _update(root, format_table(known_rows(published, measured)))
            rows.append(make_row(file, record, measured[file.sha256]))
    if write:
        _update(root, format_table(known_rows(published, measured)))
    if as_json:
        for row in rows:
            data = dataclasses.asdict(row)
            print_json(data | {"tried": [x.model_dump() for x in row.tried]})
    else:
        Console().print(_shown(rows))


def _update(root: Path, table: bytes) -> None:
    """Write the table and what the manifest says of it."""
    update_file(root / TABLE, table)
    update_file(root / MANIFEST, refresh_manifest(root, MANIFEST, all_folders()))


def _shown(rows: list[Row]) -> Table:
    table = Table(
        "controller", "seeds", "return", "min", "mm", "mrad", "% safe",
        caption="seeds: in brackets if they did not finish the turn; mm: nominal margin; mrad: "
        "mean change of the steering per step; % safe: of the runs with the paper's faults, and "
        "its 95 % interval",
        box=None, pad_edge=False,
    )  # fmt: skip
    for column in table.columns:
        column.no_wrap = True
    for row in rows:
        low, high = (100 * x for x in row.paper_safe_interval)
        table.add_row(
            row.name,
            row.seeds(),
            "" if row.training_return is None else f"{row.training_return:.0f}",
            f"{row.minutes:.0f}",
            f"{1000 * row.nominal_margin:.1f}",
            f"{1000 * row.smoothness:.1f}",
            f"{100 * row.paper_safe_fraction:.2f} ({low:.1f}-{high:.1f})",
        )
    return table

"""The command ``generator controllers``: the table of the trained controllers."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from generator.command_options import FILE, root_option
from generator.controllers_table import RUNS, Row, format_table, table_row, trained_names
from generator.progress import progress_bar
from racecar.command_line import print_json
from racecar.controller import write_whole


@click.command()
@click.argument("names", nargs=-1)
@root_option
@click.option(
    "--runs", type=click.IntRange(1), default=RUNS, show_default=True, help="Of each, with faults."
)
@click.option("-o", "--output", type=FILE, help="Also write a CSV file.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per controller.")
def controllers(
    names: tuple[str, ...], root: Path, runs: int, output: Path | None, as_json: bool
) -> None:
    """Tell of the trained controllers NAMES in ROOT/onnx, or of all, how they came out.

    Which seeds were tried and which of them finished the turn, the training's return and time,
    margin and smoothness without faults, and the share of runs that are safe under the paper's
    faults.
    """
    chosen, rows = names or trained_names(root), []
    with progress_bar(as_json) as report:
        for i, name in enumerate(chosen):
            report("controllers", i, len(chosen))
            rows.append(table_row(root, name, runs))
    if output is not None:
        write_whole(output, format_table(rows).encode())
    if as_json:
        for row in rows:
            data = dataclasses.asdict(row)
            print_json(data | {"tried": [x.model_dump() for x in row.tried]})
    else:
        Console().print(_shown(rows))


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
        seeds = [str(x.seed) if x.finishes_turn else f"({x.seed})" for x in row.tried]
        low, high = (100 * x for x in row.paper_safe_interval)
        table.add_row(
            row.name,
            " ".join(seeds),
            "" if row.training_return is None else f"{row.training_return:.0f}",
            f"{row.minutes:.0f}",
            f"{1000 * row.nominal_margin:.1f}",
            f"{1000 * row.smoothness:.1f}",
            f"{100 * row.paper_safe_fraction:.2f} ({low:.1f}-{high:.1f})",
        )
    return table

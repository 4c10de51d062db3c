"""The command ``harness export``."""

# ruff: noqa: PLC0415

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from harness.command_options import as_path
from racecar.command_line import DONE, print_json
from racecar.errors import BadInput

if TYPE_CHECKING:
    from harness.store import RunFolder


@click.command("export")
@click.argument("run", type=as_path)
@click.option("--layout", type=click.Choice(["csv", "vnncomp"]), default="csv", show_default=True)
@click.option("-o", "--output", type=as_path, required=True, metavar="PATH")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per file or folder.")
def export_command(run: Path, layout: str, output: Path, as_json: bool) -> int:
    """Write a run's results for other programs.

    csv: VNN-COMP's six columns, no header, to the file PATH. vnncomp: the VNN-LIB results, with
    witnesses, in folders TOOL/2026_BENCHMARK below PATH, as VNN-COMP's own scoring reads them.
    """
    from harness.store import RunFolder

    with RunFolder.open(run) as folder:
        if layout == "csv":
            _export_csv(folder, output, as_json)
        else:
            _export_vnncomp(folder, output, as_json)
    return DONE


def _export_csv(folder: RunFolder, output: Path, as_json: bool) -> None:
    from harness.export import results_csv
    from racecar.controller import write_whole

    if output.is_dir():
        raise BadInput(f"{output}: it is a folder; give a file")
    records = folder.records()
    write_whole(output, results_csv(records))
    if as_json:
        print_json({"file": str(output), "rows": len(records)})


def _export_vnncomp(folder: RunFolder, output: Path, as_json: bool) -> None:
    from harness.vnncomp import export_vnncomp

    if output.is_file():
        raise BadInput(f"{output}: it is a file; give a folder")
    for done in export_vnncomp(folder, output):
        for note in done.notes:
            click.echo(f"note: {note}", err=True)
        if as_json:
            print_json({"folder": str(done.folder), "rows": done.rows, "witnesses": done.witnesses})
        else:
            click.echo(f"wrote {done.folder}: {done.rows} results, {done.witnesses} witnesses")

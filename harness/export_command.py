"""The command ``harness export``."""

# ruff: noqa: PLC0415

from __future__ import annotations

from pathlib import Path

import click

from racecar.command_line import DONE, print_json
from racecar.errors import BadInput

_as_path = click.Path(path_type=Path)


@click.command("export")
@click.argument("run", type=_as_path)
@click.option("--layout", type=click.Choice(["csv", "vnncomp"]), default="csv", show_default=True)
@click.option("-o", "--output", type=_as_path, required=True, metavar="PATH")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per file or folder.")
def export_command(run: Path, layout: str, output: Path, as_json: bool) -> int:
    """Write a run's results for other programs.

    csv: VNN-COMP's six columns, no header, to the file PATH. vnncomp: the VNN-LIB results, with
    witnesses, in folders TOOL/2026_BENCHMARK below PATH, as VNN-COMP's own scoring reads them.
    """
    from harness.store import RunFolder

    folder = RunFolder.open(run)
    if layout == "csv":
        from harness.export import results_csv
        from racecar.controller import write_whole

        if output.is_dir():
            raise BadInput(f"{output}: it is a folder; give a file")
        write_whole(output, results_csv(folder.records()))
        if as_json:
            print_json({"file": str(output), "rows": len(folder.records())})
        return DONE
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
    return DONE

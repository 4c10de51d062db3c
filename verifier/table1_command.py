"""The command ``verifier table1``."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from racecar.command_line import print_json
from racecar.errors import BadInput
from racecar.safety import PROPERTIES

if TYPE_CHECKING:
    from rich.table import Table

    from verifier.table1 import Attempt, Report, Table1Row

CHECKOUT = Path(__file__).resolve().parents[1]
#: Columns where the output is not a terminal, so that rows stay in one line.
_WIDE = 140


@click.command()
@click.argument("controllers", nargs=-1, type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--root", type=click.Path(path_type=Path, file_okay=False), default=CHECKOUT,
    help="Where the folder onnx/ is whose controllers are taken if none is given  "
    "[default: the checkout]",
)  # fmt: skip
@click.option(
    "--width", "widths", multiple=True, metavar="M",
    help="Subset width to try, metres; may be repeated, the widest is tried first  "
    "[default: 0.2 (the whole range at once), 0.005, 0.002, 0.001]",
)  # fmt: skip
@click.option(
    "--property", "safety", type=click.Choice(list(PROPERTIES)), default="clearance",
    show_default=True, help="Which unsafe set.",
)  # fmt: skip
@click.option(
    "--fov", type=click.FloatRange(0, 360, min_open=True), metavar="DEGREES",
    help="Field of view of the LiDAR  [default: 230, or 270 for 1081 rays]",
)  # fmt: skip
@click.option(
    "--timeout", type=click.FloatRange(min=0, min_open=True), default=300.0, show_default=True,
    help="Seconds for each controller and width.",
)  # fmt: skip
@click.option(
    "--jobs", type=click.IntRange(min=1), default=1, show_default=True,
    help="Controllers treated at the same time, each on one core.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per controller.")
def table1(
    controllers: tuple[Path, ...], root: Path, widths: tuple[str, ...], safety: str,
    fov: float | None, timeout: float, jobs: int, as_json: bool,
) -> None:  # fmt: skip
    """Make the paper's Table 1 for CONTROLLERS (ONNX files), beside the paper's own figures.

    Each question is the paper's: the 20 cm start range, 7 s. The range is tried in subsets of
    smaller and smaller width until all subsets of one width are decided.
    """
    # Imported here: they take longer than printing a usage error should.
    from verifier.table1 import WIDTHS, Settings, subset_width, table  # noqa: PLC0415

    settings = Settings(
        tuple(sorted({subset_width(w) for w in widths}, reverse=True)) or WIDTHS,
        safety,
        timeout,
        None if fov is None else math.radians(fov),
    )
    files = list(controllers) or _all(root)
    rows: list[Table1Row] = []
    try:
        with _progress(len(files), hidden=as_json) as (report, done):
            for row in table(files, settings, jobs, report):
                done()
                rows.append(row)
                if as_json:
                    print_json(row.to_json())
    finally:
        # Also what was done before an interrupt: it may have taken hours.
        if rows and not as_json:
            _print(rows, safety)


def _all(root: Path) -> list[Path]:
    files = sorted((root / "onnx").glob("*.onnx"))
    if not files:
        raise BadInput(f"{root / 'onnx'}: there is no controller; name ONNX files or give --root")
    return files


@contextmanager
def _progress(count: int, hidden: bool) -> Iterator[tuple[Report, Callable[[], None]]]:
    """Show a bar on standard error, if that is a terminal.

    Yields what to report a controller's progress to, and what to call when one is done.
    """
    from rich.console import Console  # noqa: PLC0415 (slow to import)
    from rich.progress import Progress  # noqa: PLC0415

    console, finished = Console(stderr=True), 0
    hidden = hidden or not console.is_terminal
    with Progress(console=console, transient=True, disable=hidden) as bar:
        task = bar.add_task("controllers", total=count)

        def report(name: str, width: float, share: float) -> None:
            # A width that fails gives way to the next: the bar may go back within a controller.
            bar.update(task, completed=finished + share, description=f"{name}, {_length(width)}")

        def done() -> None:
            nonlocal finished
            finished += 1
            bar.update(task, completed=finished, description="controllers")

        yield report, done


def _print(rows: list[Table1Row], safety: str) -> None:
    from rich.console import Console  # noqa: PLC0415 (slow to import)
    from rich.table import Table  # noqa: PLC0415

    from verifier.paper_table1 import NOTE  # noqa: PLC0415

    console = Console(
        file=sys.stdout, width=None if sys.stdout.isatty() else _WIDE, highlight=False
    )
    shown = Table(title=f"20 cm start range, 7 s, {safety}", title_justify="left")
    for name in ("controller", "verdict", "subsets", "decided"):
        shown.add_column(name, no_wrap=name == "controller")
    for name in (
        "network, s", "total, s", "paths", "leaves", "margin proved, m", "margin simulated, m",
    ):  # fmt: skip
        shown.add_column(name, justify="right")
    for row in rows:
        _add(shown, row)
    console.print(shown)
    if any(row.paper for row in rows):
        console.print(NOTE)


def _add(shown: Table, row: Table1Row) -> None:
    best = row.best
    shown.add_row(
        row.controller,
        best.verdict,
        _subsets(best) if row.width is not None else f"undecided at {_tried(row)}",
        _share(best.decided),
        f"{best.network_time_s:.2f} ({best.network_time_s / max(best.time_s, 1e-9):.0%})",
        f"{best.time_s:.2f}",
        str(best.paths),
        str(best.leaves),
        _margin(best.margin_lower),
        _margin(best.margin_upper),
    )
    paper = row.paper
    if paper is None:
        return
    if paper.width is None:
        shown.add_row("  paper", paper.outcome, style="dim")
    else:
        shown.add_row(
            "  paper, per subset",
            paper.outcome,
            _length(paper.width),
            "",
            f"{paper.mean_network_time_s:g}",
            f"{paper.mean_time_s:g}",
            f"{paper.mean_paths:g}",
            style="dim",
        )


def _subsets(attempt: Attempt) -> str:
    if attempt.subsets == 1:
        return f"{_length(attempt.width)}, at once"
    return f"{attempt.subsets} of {_length(attempt.width)}"


def _tried(row: Table1Row) -> str:
    return ", ".join(_length(a.width) for a in row.tried)


def _length(metres: float) -> str:
    return f"{100 * metres:g} cm" if metres >= 0.01 else f"{1000 * metres:g} mm"


def _share(share: float) -> str:
    """Return a share in percent; what is not all must not round to 100 %."""
    return "100 %" if share == 1 else f"{min(100 * share, 99.9999):.4f} %"


def _margin(margin: float | None) -> str:
    return "" if margin is None else f"{margin:.6f}"

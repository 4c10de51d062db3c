"""A progress bar for the share of the start set that is decided."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn


@contextmanager
def share_bar(hidden: bool = False) -> Iterator[Callable[[float], None]]:
    """Show a bar on standard error, if that is a terminal; yield what to report shares to."""
    console = Console(stderr=True)
    columns = (TextColumn("decided"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    shown = console.is_terminal and not hidden
    with Progress(*columns, console=console, transient=True, disable=not shown) as progress:
        task = progress.add_task("decided", total=1.0)
        yield lambda share: progress.update(task, completed=share)

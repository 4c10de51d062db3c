"""Progress bars, on standard error and only where a person watches."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

#: Says what is being done and how much of it: (title, done, total).
Report = Callable[[str, int, int], None]


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Report]:
    """Show a bar per title; nothing with ``quiet`` or when standard error is not a terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    hidden = quiet or not sys.stderr.isatty()
    # What goes to standard output meanwhile is shown above the bar, but only if it is seen at all:
    # otherwise rich would take it away from a file or a pipe.
    seen = sys.stdout.isatty()
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=hidden, redirect_stdout=seen) as progress:
        tasks = {}

        def report(title: str, done: int, total: int) -> None:
            if title not in tasks:
                tasks[title] = progress.add_task(title, total=total)
            progress.update(tasks[title], completed=done, total=total)

        yield report

"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

as_path = click.Path(path_type=Path)


def json_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --json."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object a result.")(
        command
    )


def benchmarks_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --benchmarks."""
    return click.option(
        "--benchmarks",
        type=as_path,
        metavar="DIR",
        help="Benchmarks folder; default: ./benchmarks, else the one beside the harness.",
    )(command)

"""The options by which ``harness run`` takes limits."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from typing import Any

import click

_UNITS = {
    "": 1.0,
    "KIB": 2.0**-10,
    "MIB": 1.0,
    "GIB": 2.0**10,
    "KB": 1e3 / 2**20,
    "MB": 1e6 / 2**20,
    "GB": 1e9 / 2**20,
}


class Size(click.ParamType):
    """An amount of memory or disk: ``4096`` (MiB), ``16GB``, ``512MiB``; its value is in MiB."""

    name = "size"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the size in MiB."""
        match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([A-Za-z]*)\s*", str(value))
        scale = _UNITS.get(match[2].upper()) if match else None
        if match is None or scale is None:
            self.fail(f"{value!r} is not a size; write 4096 (MiB), 16GB or 512MiB", param, ctx)
        size = float(match[1]) * scale
        if not 2**-10 <= size < 2**40:
            self.fail(f"{value!r} is too small or too large for a limit", param, ctx)
        return size


class _Seconds(click.FloatRange):
    """A positive, finite number of seconds."""

    def __init__(self) -> None:
        super().__init__(min=0, min_open=True)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number."""
        seconds: float = super().convert(value, param, ctx)
        if not math.isfinite(seconds):
            self.fail("it must be a number of seconds", param, ctx)
        return seconds


def _size(name: str, what: str) -> Callable[[Any], Any]:
    return click.option(name, type=Size(), metavar="SIZE", help=what)


def _flag(name: str, what: str) -> Callable[[Any], Any]:
    return click.option(name, is_flag=True, help=what)


_OPTIONS = (
    click.option(
        "--cpu-limit",
        type=_Seconds(),
        metavar="S",
        help="CPU time of all processes of run_instance.sh; default: no limit.",
    ),
    _size(
        "--memory-limit",
        "Memory of all processes together, as 4096 (MiB) or 16GB; default: the machine's.",
    ),
    _size("--output-limit", "Printed output, and the result file, each; default: 1GiB."),
    _size("--scratch-limit", "Files in the scratch folder; default: the disk's."),
    _flag("--contain", "Let the tool write nowhere but in its scratch folder."),
    _flag("--fresh-home", "Give each instance an empty folder as HOME."),
    _flag("--no-cgroups", "Keep limits without control groups, even where they work."),
)


def limit_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of limits to a click command, which gets ``limits``, an Allowance."""

    @functools.wraps(command)
    def wrapped(
        cpu_limit: float | None,
        memory_limit: float | None,
        output_limit: float | None,
        scratch_limit: float | None,
        contain: bool,
        fresh_home: bool,
        no_cgroups: bool,
        **others: Any,
    ) -> Any:
        from harness.limits import Allowance  # noqa: PLC0415 (pydantic; --help needs none)

        limits = Allowance(
            cpu_s=cpu_limit,
            memory_mib=memory_limit,
            output_mib=output_limit,
            scratch_mib=scratch_limit,
            contain=contain,
            fresh_home=fresh_home,
            cgroups=not no_cgroups,
        )
        return command(limits=limits, **others)

    for option in reversed(_OPTIONS):
        wrapped = option(wrapped)
    return wrapped

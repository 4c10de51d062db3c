"""The commands about tools: ``tools``, ``new-tool``, ``check-tool``."""

# ruff: noqa: PLC0415

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from harness.command_options import as_path
from racecar.command_line import CHECK_FAILED, DONE, print_json
from racecar.errors import BadInput

if TYPE_CHECKING:
    from harness.tool import Tool

_MARKS = {"good": "ok   ", "doubt": "?    ", "wrong": "WRONG"}


@click.command("tools")
@click.option("--schema", is_flag=True, help="Print the JSON Schema of tool.toml instead.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per tool.")
def tools_command(schema: bool, as_json: bool) -> int:
    """List the tools that ship with the harness: what they read, whether they were tried."""
    from harness.description import description_schema
    from harness.tool import find_tool, shipped_tools

    if schema:
        click.echo(json.dumps(description_schema(), indent=2))
        return DONE
    found = [find_tool(name) for name in shipped_tools()]
    if as_json:
        for tool in found:
            about = tool.about.model_dump(mode="json") if tool.about else {}
            keys = ("summary", "homepage", "status", "notes", "accepts")
            shown = {key: about.get(key) for key in keys}
            print_json({"tool": tool.name, "version": tool.version, **shown})
        return DONE
    header = ("tool", "version", "status", "reads", "")
    rows = [header, *map(_row, found)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        click.echo("  ".join(cells).rstrip())
    return DONE


def _row(tool: Tool) -> tuple[str, ...]:
    about = tool.about
    if about is None:
        return tool.name, tool.version or "-", "-", "-", ""
    reads = ", ".join(about.accepts.formats)
    return tool.name, tool.version or "-", str(about.status), reads, about.summary


@click.command("new-tool")
@click.argument("name")
@click.option("--toml", "described", is_flag=True, help="A description instead of scripts.")
@click.option("-o", "--output", type=as_path, metavar="DIR", help="Default: ./NAME.")
def new_tool_command(name: str, described: bool, output: Path | None) -> int:
    """Make a folder to start a tool from; it runs as it is, and answers unknown."""
    from harness.scaffold import make_tool_folder

    target = output or Path(name)
    for file in make_tool_folder(name, target, described):
        click.echo(f"wrote {file}")
    click.echo(f"next: edit it, then try it with: harness check-tool {target}")
    return DONE


@click.command("check-tool")
@click.argument("tool")
@click.option(
    "--format",
    "formats",
    multiple=True,
    type=click.Choice(["json", "vnnlib-1.0", "vnnlib-2.0"]),
    help="Of the instances; may be repeated  [default: what the tool says it reads]",
)
@click.option(
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    default=60.0,
    show_default=True,
    metavar="S",
    help="Seconds for each instance.",
)
@click.option("--no-install", is_flag=True, help="Don't install the tool first.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per finding.")
def check_tool_command(
    tool: str, formats: tuple[str, ...], timeout: float, no_install: bool, as_json: bool
) -> int:
    """Try TOOL on tiny instances with known answers and say what is wrong, and what to do.

    TOOL is a tool that ships or a folder. Ends with status 1 if something is wrong.
    """
    from harness.check_tool import Level, check_tool
    from harness.description import Format
    from harness.tool import find_tool

    if not math.isfinite(timeout):
        raise BadInput("--timeout: it must be a number of seconds")
    found = find_tool(tool)
    counts, told = dict.fromkeys(Level, 0), set()
    wanted = [Format(name) for name in formats]
    for finding in check_tool(found, wanted, timeout, not no_install):
        counts[finding.level] += 1
        if as_json:
            print_json(dataclasses.asdict(finding))
            continue
        click.echo(f"{_MARKS[finding.level]}  {finding.where}: {finding.what}")
        # The same advice is given once.
        if finding.advice and finding.advice not in told:
            told.add(finding.advice)
            click.echo(f"       -> {finding.advice}")
            if finding.output:
                click.echo(f"       -> its output ends with: {finding.output}")
    if not as_json:
        click.echo(_conclusion(found.name, *(counts[level] for level in Level)))
    return CHECK_FAILED if counts[Level.WRONG] else DONE


def _conclusion(name: str, good: int, doubts: int, wrong: int) -> str:
    if wrong:
        return f"{name}: {wrong} wrong; mend that first"
    if good and not doubts:
        return f"{name}: all right"
    return f"{name}: nothing is wrong; {good} solved, {doubts} in doubt"

"""``harness log``: what a tool printed."""

# ruff: noqa: PLC0415 (imported when the command runs, so that no other command waits)

from __future__ import annotations

from pathlib import Path

import click

from harness.command_options import as_path, json_option
from racecar.command_line import DONE, print_json


@click.command("log")
@click.argument("run", type=as_path)
@click.argument("instance", required=False)
@json_option
def log_command(run: Path, instance: str | None, as_json: bool) -> int:
    """Print what a tool printed on an instance, or while it was installed.

    The middle of a long log is left out.
    """
    from harness.store import RunFolder

    with RunFolder.open(run) as folder:
        log = folder.log(folder.record(instance)) if instance else folder.install_log()
    if as_json:
        print_json({"instance": instance, "log": log.decode(errors="replace")})
    else:
        click.echo(log, nl=False)
    return DONE

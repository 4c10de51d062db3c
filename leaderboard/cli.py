"""The command ``leaderboard``: build a site from runs, serve it, make its certificates.

Every command imports what it needs, so that none waits for what another needs.
"""

# ruff: noqa: PLC0415

from __future__ import annotations

import time
from pathlib import Path

import click

from harness.command_options import as_path, benchmarks_option, json_option
from racecar.command_line import DONE, Commands, print_json


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Publish judged runs as a static site."""


@main.command("build")
@click.argument("runs", nargs=-1, required=True, type=as_path, metavar="RUN...")
@click.option("-o", "--output", type=as_path, required=True, metavar="SITE", help="Its folder.")
@benchmarks_option
@click.option(
    "--certificates",
    type=as_path,
    metavar="DIR",
    help="Certificates of the reference verifier (ID.h5): their reach tubes are drawn.",
)
@click.option(
    "--log-bytes",
    type=click.IntRange(0),
    default=4096,
    show_default=True,
    help="So much of each log is shown: its beginning and its end.",
)
@json_option
def build_command(
    runs: tuple[Path, ...],
    output: Path,
    benchmarks: Path | None,
    certificates: Path | None,
    log_bytes: int,
    as_json: bool,
) -> int:
    """Make a site in SITE of runs, of submissions, or of folders of these.

    Only files that changed are touched; SITE must be empty or hold a site built before.
    """
    from harness.catalogue import find_root
    from leaderboard.build import Options, build
    from leaderboard.runs import find_runs

    begun = time.monotonic()
    root = find_root(benchmarks)
    options = Options(root, certificates, log_bytes)
    built = build(find_runs(runs, root), output, options)
    for note in built.notes:
        click.echo(f"note: {note}", err=True)
    counts = {"written": built.written, "kept": built.kept, "removed": built.removed}
    if as_json:
        took = round(time.monotonic() - begun, 2)
        print_json({"site": str(output), "tools": len(built.board.tools),
                    "instances": len(built.board.instances), **counts, "time_s": took})  # fmt: skip
    else:
        click.echo(
            f"{output}: {len(built.board.tools)} tools, {len(built.board.instances)} instances; "
            f"{built.written} files written, {built.kept} unchanged, {built.removed} removed"
        )
    return DONE


@main.command("serve")
@click.argument("site", type=as_path)
@click.option("--host", default="127.0.0.1", show_default=True)
@click.option("--port", type=click.IntRange(0, 65535), default=8000, show_default=True)
def serve_command(site: Path, host: str, port: int) -> int:
    """Show a site that was built, until interrupted."""
    from leaderboard.serve import make_server

    with make_server(site, host, port) as server:
        click.echo(f"http://{host}:{server.server_port}/ (Ctrl-C ends it)")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            click.echo()
    return DONE


@main.command("certificates")
@click.argument("runs", nargs=-1, required=True, type=as_path, metavar="RUN...")
@click.option("-o", "--output", type=as_path, required=True, metavar="DIR", help="Their folder.")
@benchmarks_option
@click.option(
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    default=60.0,
    show_default=True,
    help="Seconds for each instance.",
)
@json_option
def certificates_command(
    runs: tuple[Path, ...],
    output: Path,
    benchmarks: Path | None,
    timeout: float,
    as_json: bool,
) -> int:
    """Let the reference verifier prove what some tool in the runs says is unsat.

    Writes DIR/ID.h5 for `leaderboard build --certificates DIR`; what is there already is kept.
    """
    from harness.catalogue import require_root
    from leaderboard.certificates import make_certificates
    from leaderboard.runs import find_runs

    root = require_root(benchmarks)
    for instance, outcome in make_certificates(find_runs(runs, root), root, output, timeout):
        if as_json:
            print_json({"instance": instance, "outcome": outcome})
        else:
            click.echo(f"{outcome:14}{instance}")
    return DONE

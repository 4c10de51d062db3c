"""The command ``verifier check``: the independent checker, which knows nothing of the verifier."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from racecar.command_line import CHECK_FAILED, DONE, print_json
from racecar.errors import BadInput


@click.command()
@click.argument("certificate", type=click.Path(path_type=Path))
@click.argument("instance", type=click.Path(path_type=Path))
@click.option(
    "--network",
    type=click.Path(path_type=Path),
    metavar="ONNX",
    help="The network that INSTANCE is about, if that is a question in VNN-LIB.",
)
@click.option(
    "--rows", type=click.IntRange(min=1), metavar="N",
    help="Check N rows (or boxes) drawn at random only. Finding no fault then proves nothing.",
)  # fmt: skip
@click.option("--seed", type=int, default=0, show_default=True, help="Of the draw.")
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Cores.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def check(
    certificate: Path, instance: Path, network: Path | None, rows: int | None, seed: int,
    jobs: int, as_json: bool,
) -> int:  # fmt: skip
    """Check that CERTIFICATE (HDF5) proves INSTANCE (JSON, or VNN-LIB), trusting no verifier.

    Exit status 0: it does (or, with --rows, no fault was found); 1: rejected; 2: unreadable.
    See docs/certificates.md.
    """
    from checker.files import Unreadable  # noqa: PLC0415 (slow to import)
    from checker.query.check import check as check_query  # noqa: PLC0415
    from checker.run import check as run  # noqa: PLC0415
    from verifier.progress import share_bar  # noqa: PLC0415

    try:
        with share_bar(hidden=as_json) as progress:
            if network is not None:
                found = check_query(certificate, instance, network, rows, seed, progress)
            else:
                found = run(certificate, instance, rows, seed, jobs, progress)
    except Unreadable as error:
        raise BadInput(str(error)) from None
    if as_json:
        print_json(asdict(found))
    elif found.verdict == "rejected":
        click.echo(f"rejected: {found.reason}")
    elif found.verdict == "sampled":
        click.echo(
            f"sampled: no fault in {found.checked} of {found.rows} rows; this is no proof. "
            f"Claimed margin {found.margin!r} m, {found.time_s:.1f} s"
        )
    else:
        click.echo(
            f"valid: proved margin at least {found.margin!r} m, "
            f"{found.rows} rows, {found.time_s:.1f} s"
        )
    return CHECK_FAILED if found.verdict == "rejected" else DONE

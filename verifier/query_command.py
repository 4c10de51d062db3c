"""The command ``verifier query``: a question about a network, in VNN-LIB."""

from __future__ import annotations

from pathlib import Path

import click

from racecar.command_line import print_json


@click.command()
@click.argument("network", type=click.Path(path_type=Path))
@click.argument("spec", type=click.Path(path_type=Path))
@click.option("--result", type=click.Path(path_type=Path), help="Write verdict and witness here.")
@click.option(
    "--timeout", type=click.FloatRange(min=0, min_open=True), default=60.0,
    show_default=True, help="Stop after this many seconds.",
)  # fmt: skip
@click.option(
    "--certificate", type=click.Path(path_type=Path),
    help="If the verdict is unsat, write the proof here (HDF5), for `verifier check`.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def query(
    network: Path, spec: Path, result: Path | None, timeout: float, certificate: Path | None,
    as_json: bool,
) -> None:  # fmt: skip
    """Decide SPEC (VNN-LIB) about NETWORK (ONNX): unsat, sat (with a witness), or unknown.

    Both may be gzipped. unsat is about the real-valued function of the network's numbers and is
    said only of boxes that the checker's bounds prove; see docs/certificates.md.
    """
    from racecar.controller import write_whole  # noqa: PLC0415 (slow to import)
    from verifier.query.decide import decide  # noqa: PLC0415

    answer = decide(network, spec, timeout, certificate)
    if result is not None:
        write_whole(result, f"{answer.verdict}\n{answer.witness or ''}".encode())
    if as_json:
        print_json({"spec": spec.name, **answer.to_json()})
        return
    click.echo(f"{answer.verdict}  {spec.name}")
    if answer.margin_lower is not None:
        click.echo(f"every alternative is missed by at least {answer.margin_lower:.6g}")
    if answer.margin_upper is not None:
        click.echo(f"the witness meets the conditions by {-answer.margin_upper:.6g}")
    click.echo(f"{answer.leaves} boxes, {answer.time_s:.2f} s")
    if answer.note:
        click.echo(answer.note)
    if answer.witness is not None and result is None:
        click.echo(answer.witness, nl=False)

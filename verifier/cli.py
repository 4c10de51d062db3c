"""The command ``verifier``."""

from __future__ import annotations

import os
from pathlib import Path

import click
from threadpoolctl import threadpool_limits

from racecar.command_line import Commands, print_json
from verifier.check_command import check
from verifier.query_command import query
from verifier.table1_command import table1


@click.group(cls=Commands)
def main() -> None:
    """Prove or refute instances: the reference verifier."""
    # Its matrices are small: threads would wait for each other, at twice the CPU time where
    # another program runs beside. The second is for the processes of --jobs.
    threadpool_limits(limits=1)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@main.command()
@click.argument("instance", type=click.Path(path_type=Path))
@click.option("--result", type=click.Path(path_type=Path), help="Write verdict and witness here.")
@click.option(
    "--timeout", type=click.FloatRange(min=0, min_open=True), default=300.0,
    show_default=True, help="Stop after this many seconds and say what is decided.",
)  # fmt: skip
@click.option(
    "--certificate", type=click.Path(path_type=Path),
    help="If the verdict is unsat, write the proof here (HDF5), for `verifier check`.",
)  # fmt: skip
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Cores.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def verify(
    instance: Path, result: Path | None, timeout: float, certificate: Path | None, jobs: int,
    as_json: bool,
) -> None:  # fmt: skip
    """Decide INSTANCE (a JSON file): unsat (safe), sat (with a witness), or unknown.

    Sound for the real-valued network and plant in continuous time: see docs/soundness.md.
    """
    # Imported here: they take longer than printing a usage error should.
    from racecar.controller import RuntimeSteer  # noqa: PLC0415
    from racecar.instance import controller_path  # noqa: PLC0415
    from verifier.certify import certify  # noqa: PLC0415
    from verifier.problem import load_problem  # noqa: PLC0415
    from verifier.progress import share_bar  # noqa: PLC0415
    from verifier.verify import verify_recorded  # noqa: PLC0415

    data, problem = load_problem(instance)
    steer = RuntimeSteer(controller_path(data, instance))
    with share_bar(hidden=as_json) as report:
        answer, record = verify_recorded(
            problem, steer, timeout, report, jobs, recorded=certificate is not None
        )
    if certificate is not None and record is not None and answer.margin_lower is not None:
        certify(record, answer.margin_lower, problem, data, instance, certificate)
    if result is not None:
        answer.write(result)
    if as_json:
        print_json({"instance": data.id, **answer.to_json()})
        return
    click.echo(f"{answer.verdict}  {data.id}")
    if answer.margin_lower is not None:
        click.echo(f"proved margin at least {answer.margin_lower:.6f} m")
    click.echo(f"least margin simulated {answer.margin_upper:.6f} m")
    click.echo(
        f"decided {answer.decided:.4%} of the start set, {answer.leaves} leaves, "
        f"{answer.paths} paths, {answer.time_s:.2f} s"
    )
    if answer.note:
        click.echo(answer.note)
    if answer.witness:
        click.echo("witness " + ", ".join(f"{k} = {v!r}" for k, v in answer.witness.items()))


main.add_command(check)
main.add_command(query)
main.add_command(table1)


if __name__ == "__main__":
    main()

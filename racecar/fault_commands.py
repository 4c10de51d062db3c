"""The commands about faults: ``racecar faults``, ``racecar evaluate`` and ``racecar table2``."""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from racecar.command_line import print_json
from racecar.errors import BadInput
from racecar.faultmodels.find import find_faults
from racecar.faultmodels.named import fault_names, named_faults
from racecar.faultmodels.spec import FaultSpec, fault_schema
from racecar.progress import run_progress

if TYPE_CHECKING:
    from racecar.evaluation import Evaluation, Scenario
    from racecar.table2 import Entry

_JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object per result.")
_CONTROLLER = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("name", required=False)
@click.option("--schema", is_flag=True, help="Print the JSON Schema of fault models.")
@_JSON
def faults(name: str | None, schema: bool, as_json: bool) -> None:
    """List the fault models, or print the one called NAME as JSON.

    What is printed can be kept, changed, and given to --faults of `racecar simulate`.
    """
    if schema:
        click.echo(json.dumps(fault_schema(), indent=2))
    elif name is not None:
        model = find_faults(name)
        if not isinstance(model, FaultSpec):
            raise BadInput(f"faults {name!r} are not written as JSON; see `racecar faults`")
        click.echo(model.to_json(), nl=False)
    else:
        for each in fault_names():
            model = named_faults(each)
            if as_json:
                print_json({"name": each, "description": model.description})
            else:
                click.echo(f"{each:14} {model.description}")


@click.command()
@click.argument("policy", type=_CONTROLLER)
@click.option(
    "-o", "--output", type=_CONTROLLER, metavar="FILE", help="Write the result here, as JSON."
)
@click.option(
    "--runs",
    type=click.IntRange(min=1),
    help="Of each scenario, instead of the protocol's: for a first look, not for a paper.",
)
@_JSON
def evaluate(policy: Path, output: Path | None, runs: int | None, as_json: bool) -> None:
    """Score the controller POLICY under the protocol's faults.

    Scenarios, runs and seeds are fixed, so that two results with the same protocol and hash can
    be compared. The score is the mean share of runs safe at all times, in percent.
    """
    from racecar.controller import RuntimeSteer, write_whole  # noqa: PLC0415 (slow to import)
    from racecar.evaluation import PROTOCOL, evaluate  # noqa: PLC0415

    steer = RuntimeSteer(policy)
    total = len(PROTOCOL.scored) * (runs or PROTOCOL.runs)
    with run_progress(total, as_json) as progress:
        sha256 = hashlib.sha256(policy.read_bytes()).hexdigest()
        result = evaluate(steer, steer.rays, policy.stem, sha256, runs, progress)
    if output is not None:
        write_whole(output, (result.model_dump_json(indent=2) + "\n").encode())
    if as_json:
        print_json(result.model_dump(mode="json"))
    else:
        _print_evaluation(result)


def _print_evaluation(result: Evaluation) -> None:
    from rich.console import Console  # noqa: PLC0415 (slow to import)
    from rich.table import Table  # noqa: PLC0415

    kind = "" if result.official else ", shortened: not to be compared"
    table = Table(title=f"{result.controller}: protocol {result.protocol}{kind}")
    for heading in ("faults", "runs", "safe", "95 % interval", "1 % margin", "least"):
        table.add_column(heading, justify="left" if heading == "faults" else "right", no_wrap=True)
    for scenario in (result.nominal, *result.scenarios):
        table.add_row(*_cells(scenario))
    console = Console(file=sys.stdout)
    console.print(table)
    for sets in result.ray_sets:
        what = "single ray" if sets.size == 1 else f"set of {sets.size} rays"
        console.print(
            f"every {what} missing in the turn: {sets.safe} of {sets.sets} safe, "
            f"least margin {sets.margin_min:.4f} m without {list(sets.worst)}"
        )
    console.print(f"score {result.score:.2f}")


def _cells(scenario: Scenario) -> list[str]:
    share = scenario.continuous
    low, high = share.interval
    return [
        scenario.faults,
        f"{scenario.runs:,}",
        f"{100 * share.fraction:.2f} %",
        f"{100 * low:.2f} to {100 * high:.2f}",
        f"{scenario.margin_1_percent:.3f} m",
        f"{scenario.margin_min:.3f} m",
    ]


@click.command()
@click.argument("controllers", type=_CONTROLLER, nargs=-1, required=True)
@click.option("--runs", type=click.IntRange(min=1), default=1000, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@_JSON
def table2(controllers: tuple[Path, ...], runs: int, seed: int, as_json: bool) -> None:
    """Print Table 2 of the paper for CONTROLLERS (ONNX files), with modelled environments.

    The paper drove a real car ten times in each environment; a controller of the same name
    stands beside its numbers, although it was trained anew.
    """
    from racecar.controller import RuntimeSteer  # noqa: PLC0415 (slow to import)
    from racecar.table2 import ENVIRONMENTS, table_row  # noqa: PLC0415

    rows = {}
    opened = [(file.stem, RuntimeSteer(file)) for file in controllers]
    for name, steer in opened:
        rows[name] = table_row(steer, steer.rays, name, runs, seed)
        if as_json:
            print_json(
                {"controller": name, "seed": seed, "entries": [asdict(x) for x in rows[name]]}
            )
    if not as_json:
        _print_table2(rows, ENVIRONMENTS)


def _print_table2(rows: dict[str, list[Entry]], environments: tuple[str, ...]) -> None:
    from rich.console import Console  # noqa: PLC0415 (slow to import)
    from rich.table import Table  # noqa: PLC0415

    runs = next(iter(rows.values()))[0].runs
    title = f"safe outcomes: the paper of 10, the model in % of {runs:,} runs (95 % interval)"
    # Without lines: five columns fit a terminal of 80.
    table = Table(title=title, box=None, header_style="bold", pad_edge=False)
    table.add_column("controller", no_wrap=True)
    for environment in environments:
        table.add_column("paper", justify="right", no_wrap=True)
        table.add_column(environment, justify="right", no_wrap=True)
    for name, entries in rows.items():
        cells = []
        for entry in entries:
            low, high = (100 * x for x in entry.interval)
            cells.append("" if entry.paper is None else str(entry.paper))
            cells.append(f"{100 * entry.safe / entry.runs:.1f} ({low:.1f}-{high:.1f})")
        table.add_row(name, *cells)
    Console(file=sys.stdout).print(table)

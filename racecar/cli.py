"""The command ``racecar``: ``simulate`` and ``plot``; the others are in fault_commands."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from racecar.command_line import Commands, print_json
from racecar.experiment import Experiment, run_experiment
from racecar.fault_commands import evaluate, faults, table2
from racecar.faultmodels.spec import FaultSpec
from racecar.options import Setup, describe_faults, record_faults, record_setup, setup_options
from racecar.progress import run_progress
from racecar.summary import Summary, summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@click.group(cls=Commands)
@click.version_option(package_name="closedlap")
def main() -> None:
    """Simulate, plot and score the F1/10 car of Ivanov et al. (HSCC 2020)."""


for _command in (faults, evaluate, table2):
    main.add_command(_command)


_JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


@main.command()
@setup_options
@click.option(
    "--starts", type=click.IntRange(min=1), default=1001, show_default=True, help="How many runs."
)
@_JSON
def simulate(starts: int, as_json: bool, **options: Any) -> None:
    """Run a controller in the closed loop and print how safe it is.

    Without faults the runs start evenly over the benchmark's start range (s 0.65 to 0.85 m,
    f 9.9 m, at rest, straight ahead). With faults they start at random as in the paper
    (s 0.55 to 0.95 m, f 10 m, heading up to 0.3 rad to either side).
    """
    setup = Setup(**options)
    steer = setup.open_controller()
    experiment = setup.experiment(steer.rays, starts)
    with run_progress(starts, quiet=as_json) as progress:
        began = time.perf_counter()
        outcome = run_experiment(experiment, steer, progress=progress)
        speed = outcome.steps_driven / (time.perf_counter() - began)
    summary = summarise(outcome)
    if as_json:
        record = asdict(summary) | {"steps_per_second": speed}
        print_json(record | record_setup(setup.onnx, experiment))
    else:
        _print_summary(_name(setup), experiment, summary, speed)


@main.command()
@click.argument("controllers", type=click.Path(path_type=Path, dir_okay=False), nargs=-1)
@click.option(
    "--figure",
    type=click.Choice(["3", "4", "5"]),
    help="Draw this figure of the paper for CONTROLLERS (ONNX files); 3 needs none.",
)
@setup_options
@click.option(
    "--starts",
    type=click.IntRange(1, 10_000),
    default=100,
    show_default=True,
    help="How many runs.",
)
@click.option("--whole-track", is_flag=True, help="Show the whole track, not the first turn only.")
@click.option(
    "--scan",
    "pose",
    type=(float, float, float),
    metavar="S F THETA",
    help="Draw the LiDAR scan at this pose in the first hall instead: metres, metres, degrees.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    required=True,
    metavar="FILE",
    help="The figure, .png or .svg.",
)
@_JSON
@click.pass_context
def plot(
    context: click.Context,
    controllers: tuple[Path, ...],
    figure: str | None,
    starts: int,
    whole_track: bool,
    pose: tuple[float, float, float] | None,
    output: Path,
    as_json: bool,
    **options: Any,
) -> None:
    """Draw the runs of a controller over the track, or a LiDAR scan.

    The runs are those of `racecar simulate` with the same options, drawn as in Figures 4 and
    5 of the paper. With --scan the picture is one as Figure 3, and --onnx may be left out.
    With --figure the paper's own figure is drawn, for controllers of your choice.
    """
    from racecar.figure import check_format, save_figure  # noqa: PLC0415 (slow to import)
    from racecar.figure_command import draw_figure  # noqa: PLC0415

    check_format(output)
    setup = Setup(**options)
    if figure is not None:
        _refuse(context, "--figure", keep=("starts", "seed"))
        drawn, record, message = draw_figure(figure, controllers, starts, setup.seed)
    elif controllers:
        raise click.UsageError("controllers are drawn with --figure; give a single one as --onnx")
    elif pose is None:
        drawn, record, message = _plot_traces(setup, starts, whole_track, as_json)
    else:
        _refuse(
            context, "--scan", keep=("onnx", "rays", "fov", "faults", "noise", "missing", "seed")
        )
        drawn, record, message = _plot_scan(setup, pose)
    save_figure(drawn, output)
    if as_json:
        print_json({"file": str(output)} | record)
    else:
        click.echo(f"{output}: {message}")


def _refuse(context: click.Context, why: str, keep: tuple[str, ...]) -> None:
    """Raise UsageError for an option that means nothing with ``why``, unless it is to keep."""
    kept = {*keep, why.removeprefix("--"), "output", "as_json", "controllers", "pose"}
    for name in context.params:
        if name not in kept and context.get_parameter_source(name) == ParameterSource.COMMANDLINE:
            option = name.removesuffix("_name").replace("_", "-")
            raise click.UsageError(f"--{option} means nothing with {why}; leave it out")


#: A figure, its JSON record, and one line about it.
_Plotted = tuple["Figure", dict[str, Any], str]


def _plot_traces(setup: Setup, starts: int, whole_track: bool, quiet: bool) -> _Plotted:
    from racecar.plot import draw_traces  # noqa: PLC0415 (slow to import)

    steer = setup.open_controller()
    experiment = setup.experiment(steer.rays, starts)
    with run_progress(starts, quiet) as progress:
        outcome = run_experiment(experiment, steer, record=True, progress=progress)
    summary = summarise(outcome)
    share = f"{summary.safe} of {starts} runs safe ({100 * summary.safe_fraction:.3g} %)"
    seconds = experiment.steps * experiment.plant.period
    figure = draw_traces(
        experiment.plant,
        experiment.safety,
        outcome,
        title=f"{_name(setup)}: {share}",
        subtitle=f"{seconds:g} s, {describe_faults(experiment.faults)}",
        whole_track=whole_track,
    )
    return figure, asdict(summary) | record_setup(setup.onnx, experiment), share


def _plot_scan(setup: Setup, pose: tuple[float, float, float]) -> _Plotted:
    from racecar.plot_scan import draw_scan, take_scan  # noqa: PLC0415 (slow to import)

    steer = None if setup.onnx is None else setup.open_controller()
    rays = steer.rays if steer else 21 if setup.rays is None else setup.rays
    plant, faults = setup.plant(rays), setup.fault_model()
    (s, f, degrees), theta = pose, math.radians(pose[2])
    scan = take_scan(plant, s, f, theta, faults, setup.seed, steer)
    missing = [i for i, gone in enumerate(scan.missing) if gone]
    parts = [f"{rays} rays over {math.degrees(plant.lidar.field_of_view):g}°"]
    if isinstance(faults, FaultSpec):
        parts.append(f"faults {faults.name}, {len(missing) or 'none'} missing here")
    else:
        if faults.missing:
            parts.append(f"{len(missing) or 'none'} missing here")
        if faults.noise:
            parts.append(f"noise up to {faults.noise:g} m")
    if scan.steering is not None:
        angle = math.degrees(scan.steering)
        side = "left" if angle > 0 else "right"
        parts.append(f"{_name(setup)} steers {abs(angle):.1f}° {side}")
    heading = f"{degrees:g}".replace("-", "\N{MINUS SIGN}")
    figure = draw_scan(
        plant,
        scan,
        title=f"LiDAR scan at s = {s:g} m, f = {f:g} m, heading {heading}°",
        subtitle=", ".join(parts),
    )
    record = {
        "s": s,
        "f": f,
        "theta": theta,
        "distances": scan.distances.tolist(),
        "missing": missing,
        "steering": scan.steering,
        "rays": rays,
        "field_of_view": plant.lidar.field_of_view,
        "noise": record_faults(faults)["noise"],
        "seed": setup.seed,
    }
    return figure, record, f"scan of {rays} rays, {len(missing)} missing"


def _name(setup: Setup) -> str:
    return setup.onnx.stem if setup.onnx else ""


def _print_summary(name: str, experiment: Experiment, summary: Summary, speed: float) -> None:
    from rich.console import Console  # noqa: PLC0415 (slow to import)
    from rich.table import Table  # noqa: PLC0415

    low, high = summary.safe_fraction_interval
    worst = summary.worst_start
    seconds = experiment.steps * experiment.plant.period
    table = Table(title=name, show_header=False, title_justify="left")
    table.add_column(no_wrap=True)
    table.add_column(justify="right")
    for row in (
        ("runs", f"{summary.runs}, each of {seconds:g} s"),
        ("faults", describe_faults(experiment.faults)),
        ("property", experiment.safety.name),
        ("safe at control instants", f"{summary.safe} ({100 * summary.safe_fraction:.2f} %)"),
        ("  95 % confidence interval", f"{100 * low:.2f} to {100 * high:.2f} %"),
        ("safe at all times", f"{100 * summary.safe_fraction_continuous:.2f} %"),
        ("least margin at control instants", f"{summary.margin_min_sampled:.6f} m"),
        ("least margin at all times", f"{summary.margin_min:.6f} m"),
        ("  in the run from", f"s {worst['s']:.6g} m, heading {worst['theta']:.6g} rad"),
        ("speed", f"{speed:,.0f} steps/s"),
    ):
        table.add_row(*row)
    Console(file=sys.stdout).print(table)

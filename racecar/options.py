"""The options that ``racecar simulate`` and ``racecar plot`` share, and what they describe."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.errors import BadInput
from racecar.experiment import (
    STEPS,
    EvenStarts,
    Experiment,
    RandomStarts,
    Starts,
    default_field_of_view,
)
from racecar.faultmodels.find import find_faults
from racecar.faultmodels.spec import FaultSpec
from racecar.faults import FAULTS, Faults
from racecar.lidar import Lidar
from racecar.safety import PROPERTIES, named_property
from racecar.track import square_track

if TYPE_CHECKING:
    from racecar.controller import RuntimeSteer


@dataclass(frozen=True)
class Setup:
    """The shared options as given; None where one was not.

    fov: degrees; noise and start: metres; the rest as racecar.experiment.Experiment has it.
    """

    onnx: Path | None
    rays: int | None
    fov: float | None
    slip: bool
    faults: str
    noise: float | None
    missing: int | None
    start: tuple[float, float] | None
    steps: int
    property_name: str
    seed: int

    def fault_model(self) -> Faults | FaultSpec:
        """Return the named fault model with the numbers that were given."""
        try:
            model = find_faults(self.faults)
        except BadInput as error:
            raise BadInput(f"--faults: {error}") from None
        if isinstance(model, FaultSpec):
            if self.noise is not None or self.missing is not None:
                raise click.UsageError(
                    f"--noise and --missing mean nothing with --faults {self.faults}; "
                    "write the numbers into a file of your own"
                )
            return model
        if self.noise is not None:
            model = replace(model, noise=self.noise)
        if self.missing is not None:
            model = replace(model, missing=self.missing)
        return model

    def open_controller(self) -> RuntimeSteer:
        """Open the controller; BadInput if there is none or it reads other rays than given."""
        from racecar.controller import RuntimeSteer  # noqa: PLC0415 (slow to import)

        if self.onnx is None:
            raise click.UsageError("Missing option '--onnx'.")
        steer = RuntimeSteer(self.onnx)
        if self.rays not in (None, steer.rays):
            raise BadInput(f"{self.onnx}: it reads {steer.rays} rays, but --rays is {self.rays}")
        return steer

    def plant(self, rays: int) -> Plant:
        """Return the car on the paper's track with a LiDAR of so many rays."""
        view = default_field_of_view(rays) if self.fov is None else math.radians(self.fov)
        return Plant(square_track(), Bicycle(slip=self.slip), Lidar(rays, view))

    def experiment(self, rays: int, runs: int) -> Experiment:
        """Return the experiment: even starts without faults, random ones with them."""
        plant, faults = self.plant(rays), self.fault_model()
        kind = EvenStarts if faults == FAULTS["none"] else RandomStarts
        starts: Starts = kind() if self.start is None else kind(s=self.start)
        safety = named_property(self.property_name, plant.track)
        return Experiment(plant, safety, starts, faults, runs, self.steps, self.seed)


_OPTIONS = (
    click.option(
        "--onnx",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="The controller, an ONNX file.",
    ),
    click.option("--rays", type=int, help="Rays of the LiDAR; by default what the file reads."),
    click.option(
        "--fov",
        type=float,
        metavar="DEGREES",
        help="Field of view of the LiDAR; by default 230, with 1081 rays 270.",
    ),
    click.option("--slip", is_flag=True, help="Model the slip angle of the car."),
    click.option(
        "--faults",
        metavar="NAME|FILE",
        default="none",
        show_default=True,
        help="paper: 5 rays drawn to be missing in the turn, noise up to 0.2 m; "
        "noise: noise up to 0.1 m; or a model that `racecar faults` lists, or a .json file.",
    ),
    click.option(
        "--noise", type=float, metavar="METRES", help="Noise up to this, instead of theirs."
    ),
    click.option(
        "--missing", type=int, metavar="K", help="Rays drawn to be missing, instead of theirs."
    ),
    click.option(
        "--start",
        type=(float, float),
        metavar="LO HI",
        help="Range of s at the start, metres; by default 0.65 0.85, with faults 0.55 0.95.",
    ),
    click.option(
        "--steps",
        type=click.IntRange(1, 100_000),
        default=STEPS,
        show_default=True,
        help="Control periods of 0.1 s; a lap takes about 320.",
    ),
    click.option(
        "--property",
        "property_name",
        type=click.Choice(list(PROPERTIES)),
        default="clearance",
        show_default=True,
        help="Which unsafe set.",
    ),
    click.option(
        "--seed",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Of starts and faults.",
    ),
)


def setup_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the shared options to a command; ``Setup(**options)`` takes them all."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def describe_faults(faults: Faults | FaultSpec) -> str:
    """Return a fault model in words."""
    if isinstance(faults, FaultSpec):
        return f"faults {faults.name}"
    parts = []
    if faults.missing:
        where = " in the turn" if faults.turn_only else ""
        parts.append(f"up to {faults.missing} rays missing{where}")
    if faults.noise:
        parts.append(f"noise up to {faults.noise:g} m")
    return ", ".join(parts) or "no faults"


def record_setup(onnx: Path | None, experiment: Experiment) -> dict[str, Any]:
    """Return what was run, as fields of a JSON record (SI units and radians)."""
    lidar = experiment.plant.lidar
    return {
        "onnx": str(onnx),
        "rays": lidar.rays,
        "field_of_view": lidar.field_of_view,
        "slip": experiment.plant.bicycle.slip,
        **record_faults(experiment.faults),
        "property": experiment.safety.name,
        "steps": experiment.steps,
        "seed": experiment.seed,
    }


def record_faults(faults: Faults | FaultSpec) -> dict[str, Any]:
    """Return a fault model as fields of a JSON record; numbers it does not have are null."""
    if isinstance(faults, FaultSpec):
        return {
            "faults": faults.name,
            "faults_sha256": faults.sha256(),
            "missing": None,
            "noise": None,
        }
    name = next((name for name, model in FAULTS.items() if model == faults), "custom")
    return {"faults": name, "missing": faults.missing, "noise": faults.noise}

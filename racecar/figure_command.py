"""What ``racecar plot --figure`` runs before it draws."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from matplotlib.figure import Figure

from racecar.controller import RuntimeSteer
from racecar.experiment import (
    EvenStarts,
    Experiment,
    RandomStarts,
    paper_plant,
    run_experiment,
)
from racecar.faultmodels.named import named_faults
from racecar.faults import FAULTS
from racecar.plot_figures import Panel, draw_controllers, draw_scans
from racecar.plot_scan import take_scan
from racecar.safety import named_property
from racecar.table2 import ENVIRONMENTS

#: Where Figure 3's scans are taken: where the car begins to turn (m, m, rad).
_POSE = (0.6, 1.8, 0.0)


def draw_figure(
    number: str, controllers: tuple[Path, ...], runs: int, seed: int
) -> tuple[Figure, dict[str, Any], str]:
    """Return a figure of the paper, its JSON record and one line about it.

    number: "3", "4" or "5"; controllers: ONNX files, the first one's rays are those of Figure 3.
    """
    if number == "3":
        return _scans(controllers, seed)
    if not controllers:
        raise click.UsageError(f"figure {number} shows controllers; give their ONNX files")
    panels, safe = [], {}
    for file in controllers:
        steer = RuntimeSteer(file)
        plant = paper_plant(steer.rays)
        safety = named_property("clearance", plant.track)
        faults = FAULTS["none"] if number == "4" else FAULTS["paper"]
        starts = EvenStarts() if number == "4" else RandomStarts()
        experiment = Experiment(plant, safety, starts, faults, runs, seed=seed)
        outcome = run_experiment(experiment, steer, record=True)
        panels.append(Panel(file.stem, outcome))
        safe[file.stem] = int(outcome.safe.sum())
    what = "without faults" if number == "4" else "5 rays missing in the turn, noise up to 0.2 m"
    figure = draw_controllers(plant, safety, panels, f"{runs} runs of 7 s, {what}")
    record = {"figure": int(number), "runs": runs, "seed": seed, "safe": safe}
    return figure, record, ", ".join(f"{k}: {v} of {runs} safe" for k, v in safe.items())


def _scans(controllers: tuple[Path, ...], seed: int) -> tuple[Figure, dict[str, Any], str]:
    steer = RuntimeSteer(controllers[0]) if controllers else None
    plant = paper_plant(steer.rays if steer else 21)
    scans = {
        f"{name} environment": take_scan(plant, *_POSE, named_faults(name), seed, steer)
        for name in ENVIRONMENTS
    }
    s, f, _ = _POSE
    title = f"LiDAR scans of {plant.lidar.rays} rays at s = {s:g} m, f = {f:g} m"
    record = {
        "figure": 3,
        "seed": seed,
        "missing": {name: int(scan.missing.sum()) for name, scan in scans.items()},
    }
    return draw_scans(plant, scans, title), record, title

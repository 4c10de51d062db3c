"""Reference traces: what the simulator makes of a controller, for others to compare with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from generator.hdf5 import Dataset, Group
from generator.instances import ControllerFile, benchmark_plant
from racecar.closed_loop import Plant, State, simulate
from racecar.polygon import Array
from racecar.safety import PROPERTIES, named_property

STARTS, STEPS = 21, 70
#: Scans of more rays, and of further seeds of a setup, are left out: they would be half a megabyte
#: for a controller, and follow from the states.
MOST_RAYS = 21

_STATES = {
    "frame": ("1", "hall that the local frame belongs to, counted from 0"),
    "s": ("m", "distance to the left wall of the hall"),
    "f": ("m", "distance to the front wall of the hall"),
    "v": ("m/s", "speed"),
    "theta": ("rad", "heading, 0 along the hall, counter-clockwise positive"),
}


def trace_group(file: ControllerFile, field_of_view: float) -> Group:
    """Return the traces of a controller from evenly spaced starts in [0.65, 0.85] m.

    field_of_view: radians. The network is evaluated in float64 on its float32 weights.
    """
    plant = benchmark_plant(file.controller.rays, field_of_view)
    start = State.start(np.linspace(0.65, 0.85, STARTS))
    scans = np.full((STARTS, STEPS, file.controller.rays), np.nan)

    def keep(step: int, state: State, scan: Array) -> Array:
        scans[:, step] = scan.T
        return scan

    runs = simulate(
        plant,
        file.controller.steering_rows,
        named_property("clearance", plant.track),
        start,
        STEPS,
        disturb=keep,
        record=True,
    )
    assert runs.trace is not None
    steering = runs.trace["steering"]
    scans[np.isnan(steering)] = np.nan  # a run that has ended measures nothing
    members: dict[str, Dataset | Group] = {
        "time": Dataset(np.arange(STEPS + 1) * plant.period, "s", "control instants, [steps + 1]"),
    }
    for name, (units, description) in _STATES.items():
        values = runs.trace[name].astype("<i8" if name == "frame" else "<f8")
        members[name] = Dataset(
            values, units, f"{description}; at the control instants, [starts, steps + 1]"
        )
    if file.controller.rays <= MOST_RAYS and not file.further_seed:
        members["scan"] = Dataset(
            scans, "m", "LiDAR distances, first ray at the right end, [starts, steps, rays]"
        )
    members["steering"] = Dataset(
        steering, "rad", "steering angle, left positive, held for the period, [starts, steps]"
    )
    members |= {name: _margins(name, plant, runs.trace) for name in PROPERTIES}
    return Group(
        f"closed loop of {file.name} from {STARTS} starts; a run ends early where the property "
        "clearance is violated: from there on states stay and scan, steering and margins are NaN",
        members,
        {"onnx_sha256": file.sha256},
    )


def _margins(name: str, plant: Plant, trace: dict[str, Array]) -> Group:
    """Return the margins of a property along a recorded trace."""
    safety = named_property(name, plant.track)
    starts, steps = trace["steering"].shape
    instant, period = np.full((starts, steps + 1), np.nan), np.full((starts, steps), np.nan)
    for step in range(steps + 1):
        going = np.flatnonzero(
            np.isfinite(trace["steering"][:, step - 1]) if step else np.ones(starts, dtype=bool)
        )
        if not going.size:
            break
        instant[going, step] = plant.margin(safety, _state(trace, going, step))
        if step < steps:
            driving = going[np.isfinite(trace["steering"][going, step])]
            before = _state(trace, driving, step)
            _, arc = plant.drive(before, trace["steering"][driving, step])
            period[driving, step] = plant.arc_margin(
                safety, before, arc, np.full(driving.size, np.inf)
            )
    return Group(
        f"margins of the property {name}: {PROPERTIES[name]}",
        {
            "instant": Dataset(instant, "m", "margin at the control instants, [starts, steps + 1]"),
            "period": Dataset(
                period, "m", "least margin during each control period, [starts, steps]"
            ),
            "run": Dataset(
                np.nanmin(np.column_stack([instant[:, :1], period]), axis=1),
                "m",
                "least margin at any time of the run, [starts]",
            ),
        },
    )


def _state(trace: dict[str, Array], cars: NDArray[np.intp], step: int) -> State:
    return State(
        trace["frame"][cars, step],
        *(trace[name][cars, step] for name in ("s", "f", "v", "theta")),
    )

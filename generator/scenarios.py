"""Fault scenarios as HDF5: starts of runs and what goes wrong in them, value by value."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from generator.hdf5 import Dataset, Group, floats, to_bytes
from racecar.closed_loop import Plant, State
from racecar.errors import BadInput
from racecar.experiment import Experiment, RandomStarts, block_random
from racecar.faultmodels.draw import spec_faults
from racecar.faultmodels.scenario import DrawnPart, Scenario, draw_scenario
from racecar.faultmodels.spec import FaultSpec, parse_faults
from racecar.safety import named_property

FORMAT = "closedlap-scenarios 1"
#: A file holds at most so many runs: one block of randomness of an experiment.
MOST_RUNS = 1024

_STATE = {"s": ("m", "distance to the left wall"), "f": ("m", "distance to the front wall"),
          "v": ("m/s", "speed"), "theta": ("rad", "heading, counter-clockwise")}  # fmt: skip


def make_scenarios(spec: FaultSpec, plant: Plant, runs: int, steps: int, seed: int) -> bytes:
    """Return the HDF5 file of the runs that ``racecar simulate`` makes of model and seed.

    At most MOST_RUNS runs, from the paper's random starts.
    """
    if not 1 <= runs <= MOST_RUNS:
        raise BadInput(f"scenarios: {runs} runs; a file holds 1 to {MOST_RUNS}")
    safety = named_property("clearance", plant.track)
    experiment = Experiment(plant, safety, RandomStarts(), spec, runs, steps, seed)
    numbers = np.arange(runs)
    start = experiment.starts.states(numbers, runs, block_random(seed, 0))
    scenario = draw_scenario(spec_faults(spec, plant, numbers, seed), steps)
    members: dict[str, Dataset | Group] = {
        name: Dataset(floats(getattr(start, name)), units, f"start of each run: {meaning}")
        for name, (units, meaning) in _STATE.items()
    }
    for place, part in enumerate(scenario.parts):
        members[f"part_{place}"] = _part(part)
    description = (
        "runs with LiDAR faults; every reading is the sum of the distance and all noise, clipped "
        "to [0, range], and the range where a ray is missing"
    )
    attributes = {
        "format": FORMAT,
        "faults": spec.to_json(),
        "seed": str(seed),
        "steps": str(steps),
    }
    return to_bytes(Group(description, members, attributes))


def _part(part: DrawnPart) -> Group:
    members: dict[str, Dataset | Group] = {
        "happens": Dataset(part.happens.astype("u1"), "1", "1 for the runs it happens to; [run]")
    }
    if part.noise is not None:
        text = "added to every reading; [step, run, ray]"
        members["noise"] = Dataset(floats(part.noise), "m", text)
    if part.missing is not None:
        where = "in the turn (0 < s < W and f <= W + 1)" if part.turn_only else "everywhere"
        axes = "[step, run, ray]" if part.missing.ndim == 3 else "[run, ray]"
        members["missing"] = Dataset(
            part.missing.astype("u1"), "1", f"1 for rays that are missing {where}; {axes}"
        )
    if part.ends is not None:
        text = "mirrors in the global frame; [mirror, run, begin or end, x or y]"
        members["ends"] = Dataset(floats(part.ends), "m", text)
        text = "rays that meet a mirror beyond this angle to its normal are missing"
        members["incidence"] = Dataset(floats(part.incidence), "rad", text)
    attributes = {"kind": part.kind, "turn_only": str(int(part.turn_only))}
    return Group(f"part of the fault model, of kind {part.kind}", members, attributes)


def load_scenarios(path: Path, plant: Plant) -> tuple[FaultSpec, State, Scenario]:
    """Read a file: the model that it was drawn from, the starts and the faults of its runs."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise BadInput(f"{path}: not a scenario file of the format {FORMAT}")
            start = State.start(*(file[name][()] for name in _STATE))
            spec = parse_faults(file.attrs["faults"], str(path))
            count = sum(name.startswith("part_") for name in file)
            parts = tuple(_read(file[f"part_{place}"]) for place in range(count))
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read as scenarios: {error}") from None
    return spec, start, Scenario(plant, parts)


def _read(group: h5py.Group) -> DrawnPart:
    incidence = float(group["incidence"][()]) if "incidence" in group else 0.0
    return DrawnPart(
        str(group.attrs["kind"]),
        group["happens"][()].astype(bool),
        group["noise"][()] if "noise" in group else None,
        group["missing"][()].astype(bool) if "missing" in group else None,
        group.attrs["turn_only"] == "1",
        group["ends"][()] if "ends" in group else None,
        incidence,
    )

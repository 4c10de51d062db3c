"""Instance files and problems for the tests of whole verdicts."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path

import numpy as np
from enclosed import TRACKS, problem_of

from racecar.closed_loop import State, simulate
from racecar.controller import Controller, RuntimeSteer, save_controller
from racecar.instance import Instance, parse_instance, plant_data, property_data, save_instance
from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.safety import Property, named_property
from racecar.track import Track
from verifier.problem import Problem


def everywhere(name: str, track: Track, *polygons: list[list[float]]) -> Property:
    """Return the same unsafe polygons in every frame."""
    unsafe = tuple(Polygon.from_constraints(p) for p in polygons)
    return Property(name, (unsafe,) * len(track.frames))


def grown(safety: Property, by: float) -> Property:
    """Return a property whose unsafe polygons are ``by`` metres larger all around.

    Every miss is smaller by as much, so that the margin of every run is exactly that less.
    """
    unsafe = tuple(
        tuple(Polygon(p.normals, p.offsets + by) for p in polygons) for polygons in safety.unsafe
    )
    return Property(f"{safety.name}-grown", unsafe)


def question(controller: Controller, lower: list[float], upper: list[float], **extra) -> Problem:
    track = extra.get("track", TRACKS["square"])
    given = {"safety": named_property("clearance", track)} | extra
    given.pop("track", None)
    return problem_of(
        track, Lidar(controller.rays), controller,
        lower=np.array(lower), upper=np.array(upper), **given,
    )  # fmt: skip


def least_simulated(problem: Problem, count: int = 2001) -> float:
    """Return the least margin of runs evenly spread over a box of one dimension."""
    starts = problem.lower + np.linspace(0, 1, count)[:, None] * (problem.upper - problem.lower)
    steer = problem.controller.steering_rows
    runs = simulate(problem.plant, steer, problem.safety, State.start(*starts.T), problem.steps)
    return float(runs.margin.min())


def replayed(problem: Problem, witness: dict[str, float]) -> float:
    """Return the margin of a witness in onnxruntime, as the harness judges it."""
    state = State.start(*(witness[n] for n in ("s", "f", "v", "theta")))
    steer = RuntimeSteer(problem.controller)
    runs = simulate(problem.plant, steer, problem.safety, state, problem.steps)
    return float(runs.margin[0])


def save(problem: Problem, folder: Path, name: str = "instance") -> Path:
    """Write a problem as an instance file, its controller beside it."""
    save_controller(problem.controller, folder / "controller.onnx")
    content = (folder / "controller.onnx").read_bytes()
    box = {
        key: [float(problem.lower[i]), float(problem.upper[i])]
        for i, key in enumerate(("s", "f", "v", "theta"))
    }
    data = {
        "id": name,
        "category": "test",
        "controller": {
            "name": "controller",
            "file": "controller.onnx",
            "sha256": hashlib.sha256(content).hexdigest(),
        },
        "plant": plant_data(problem.plant).model_dump(mode="json"),
        "initial_set": box,
        "steps": problem.steps,
        "property": property_data(problem.safety).model_dump(mode="json"),
    }
    path = folder / f"{name}.json"
    instance: Instance = parse_instance(json.dumps(data), str(path))
    save_instance(instance, path)
    return path


#: Straight ahead into the next hall: the first frame's advance is passed on the way.
ALONG = -math.pi / 2

"""Speed of the closed loop on one core, beside the network's matrix products alone.

    python -m bench.closed_loop [--json]

Each round measures the closed loop, then the matrix products in float32 and in float64; the
medians over the rounds are reported, so that load on the machine touches all alike.
"""

# ruff: noqa: E402 (the environment must be set before NumPy is imported)

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import json
import math
import sys
from dataclasses import dataclass
from statistics import median
from time import process_time

import numpy as np

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State, simulate
from racecar.controller import Controller, Layer, RuntimeSteer
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import square_track

CARS, STEPS = 4096, 70


@dataclass(frozen=True)
class Case:
    """One setup; rounds: how often everything is measured."""

    rays: int
    degrees: float
    hidden: int
    rounds: int


CASES = (Case(21, 230, 64, 15), Case(1081, 270, 128, 5))


def driving_controller(case: Case) -> Controller:
    """Return a controller with random weights that drives the car through the hall.

    One neuron a layer compares the space on the left with that on the right: random weights
    alone would hit the wall within seconds, and cars that stand still would be measured.
    """
    random = np.random.default_rng(0)
    shapes = ((case.hidden, case.rays), (case.hidden, case.hidden), (1, case.hidden))
    layers = []
    for out, into in shapes:
        weights = random.normal(0, 0.1 / math.sqrt(into), (out, into))
        weights[0] *= 0.01
        layers.append((weights, "tanh"))
    angles = np.degrees(Lidar(case.rays, math.radians(case.degrees)).angles)
    aside = np.sign(angles) * (np.abs(angles) > 10) * (np.abs(angles) < 70)
    layers[0][0][0] += 0.8 * aside / np.sum(aside > 0)
    layers[1][0][0, 0] += 2
    layers[2][0][0, 0] += 2
    layers.append((np.full((1, 1), math.radians(15)), "linear"))
    return Controller(
        tuple(
            Layer(w.astype(np.float32), np.zeros(len(w), dtype=np.float32), activation)
            for w, activation in layers
        )
    )


def products_alone(controller: Controller, scan: np.ndarray) -> float:
    """Return the seconds that the matrix products of one step take; scan: ``[cars, rays]``."""
    weights = [np.ascontiguousarray(x.weights.T, dtype=scan.dtype) for x in controller.layers[:3]]
    outs = [np.empty((len(scan), w.shape[1]), dtype=scan.dtype) for w in weights]
    times = []
    for _ in range(5):
        begin, x = process_time(), scan
        for w, out in zip(weights, outs, strict=True):
            x = np.matmul(x, w, out=out)
        times.append(process_time() - begin)
    return median(times)


def measure(case: Case) -> dict[str, float]:
    """Return the medians of one setup."""
    plant = Plant(square_track(), Bicycle(), Lidar(case.rays, math.radians(case.degrees)))
    safety = named_property("clearance", plant.track)
    controller = driving_controller(case)
    steer = RuntimeSteer(controller)
    start = State.start(np.linspace(0.65, 0.85, CARS))
    scan = plant.scan_rows(start).T
    blocks = [scan[i : i + steer.cars_at_once].T for i in range(0, CARS, steer.cars_at_once)]
    block_memory = np.empty((min(CARS, steer.cars_at_once), case.rays))
    float32 = scan.astype(np.float32)
    loops, networks, products32, products64, scans = [], [], [], [], []
    for _ in range(case.rounds):
        begin = process_time()
        runs = simulate(plant, steer, safety, start, STEPS)
        loops.append((process_time() - begin) / STEPS)
        begin = process_time()
        for block in blocks:
            steer(block)
        networks.append(process_time() - begin)
        begin = process_time()
        for _ in plant.scan_blocks(start, block_memory):
            pass
        scans.append(process_time() - begin)
        products32.append(products_alone(controller, float32))
        products64.append(products_alone(controller, scan))
    loop = median(loops)
    return {
        "rays": case.rays,
        "hidden": case.hidden,
        "cars": CARS,
        "steps": STEPS,
        "still_driving": float(np.mean(runs.crash_step < 0)),
        "steps_per_second": CARS / loop,
        "microseconds_per_step": 1e6 * loop / CARS,
        "network_microseconds": 1e6 * median(networks) / CARS,
        "scan_microseconds": 1e6 * median(scans) / CARS,
        "products_float32_microseconds": 1e6 * median(products32) / CARS,
        "products_float64_microseconds": 1e6 * median(products64) / CARS,
        "ratio_float32": loop / median(products32),
        "ratio_float64": loop / median(products64),
    }


def main() -> None:
    """Print the results, as text or (``--json``) one JSON object each."""
    for case in CASES:
        result = measure(case)
        if "--json" in sys.argv[1:]:
            print(json.dumps(result), flush=True)
        else:
            print(f"{case.rays} rays, {case.hidden}x{case.hidden}")
            for name, value in result.items():
                print(f"  {name:32} {value:.6g}", flush=True)


if __name__ == "__main__":
    main()

"""The reference verifier on one core, beside simulation, and its cost against the rays.

    python -m bench.proofs [CONTROLLER...] [--rays N...] [--base CONTROLLER] [--limit S]
                             [--skip ratios|rays] [--json]

CONTROLLER: ONNX files, or networks in the YAML layout that Verisig reads; default: all in onnx/.

Two tables. For each controller: the time to decide the whole 20 cm start range (a library call,
the second of two, so that nothing is loaded or compiled), over the time to simulate 10,000
starts of it as ``racecar simulate`` does. Against the rays: the same for one network spread over
finer and finer scans, with the peak memory of a process of its own (that does both), and the
exponents that fit.
There the unsafe set is 5 cm smaller: spreading changes the margin, and this table is to show
what rays cost, not what a narrow margin does. All times are processor times of one core, in one
run; medians of several where they are short.
"""

# ruff: noqa: E402 (the environment must be set before NumPy is imported)

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

import numpy as np

from generator.yaml_network import import_yaml
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.controller import Controller, Layer, RuntimeSteer, load_controller
from racecar.experiment import EvenStarts, Experiment, default_field_of_view, run_experiment
from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.safety import Property, named_property
from racecar.track import square_track
from verifier.problem import Problem
from verifier.verify import verify

ONNX = Path(__file__).resolve().parents[1] / "onnx"
RUNS = 10_000
RAYS = (21, 61, 121, 271, 541, 1081)
BASE = ONNX / "TD3_L21_128x128_C1.onnx"
#: In the table against the rays the unsafe set is so much smaller (m).
SMALLER = 0.05
#: Measurements are repeated until they took this many seconds, at most so many times.
ENOUGH, MOST = 5.0, 5
#: Proofs that take so many seconds are not repeated.
LONG = 60.0


def read(path: Path) -> Controller:
    """Read a controller, ONNX or YAML."""
    return (
        import_yaml(path, path.stem) if path.suffix in {".yml", ".yaml"} else load_controller(path)
    )


def spread(controller: Controller, rays: int) -> Controller:
    """Return a controller that reads a finer scan over the same field of view.

    Each ray's weight is shared out by a hat function among the finer rays around it, so that
    its reading becomes a weighted mean of theirs; the same number of rays changes nothing.
    """
    first, *others = controller.layers
    coarse, fine = np.linspace(0, 1, controller.rays), np.linspace(0, 1, rays)
    apart = np.abs(coarse[:, None] - fine[None, :]) * (controller.rays - 1)
    hats = np.maximum(0.0, 1 - apart)  # [coarse, fine]
    hats /= hats.sum(axis=1, keepdims=True)
    weights = (first.weights.astype(float) @ hats).astype(np.float32)
    return Controller((Layer(weights, first.biases, first.activation), *others))


def question(controller: Controller, field_of_view: float, smaller: float = 0.0) -> Problem:
    """Return the benchmark's question about the whole start range.

    smaller: the unsafe polygons are so much (m) smaller all around.
    """
    track = square_track()
    safety = named_property("clearance", track)
    unsafe = tuple(
        tuple(Polygon(p.normals, p.offsets - smaller) for p in polygons)
        for polygons in safety.unsafe
    )
    plant = Plant(track, Bicycle(), Lidar(controller.rays, field_of_view))
    (low, high), f = EvenStarts().s, EvenStarts().f
    return Problem(
        plant, controller, Property(safety.name, unsafe), 70,
        np.array([low, f, 0.0, 0.0]), np.array([high, f, 0.0, 0.0]),
    )  # fmt: skip


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the median processor time of some work, and its last result."""
    times: list[float] = []
    while not times or (len(times) < MOST and sum(times) < ENOUGH):
        began = process_time()
        result = work()
        times.append(process_time() - began)
    return median(times), result


def measure(problem: Problem, limit: float) -> dict[str, Any]:
    """Return the cost of deciding a problem and of simulating ``RUNS`` starts."""
    steer = RuntimeSteer(problem.controller)
    experiment = Experiment(problem.plant, problem.safety, EvenStarts(), runs=RUNS)
    run_experiment(Experiment(problem.plant, problem.safety, EvenStarts(), runs=100), steer)
    began = process_time()
    result = verify(problem, steer, limit)
    verified = process_time() - began
    # What took a minute, or all the time there was, is not made much faster by being warm.
    if verified < LONG and result.verdict != "unknown":
        verified, result = seconds(lambda: verify(problem, steer, limit))
    simulated, outcome = seconds(lambda: run_experiment(experiment, steer))
    return {
        "rays": problem.controller.rays,
        "verdict": result.verdict,
        "decided": result.decided,
        "leaves": result.leaves,
        "paths": result.paths,
        "margin_lower": result.margin_lower,
        "margin_upper": float(outcome.runs.margin.min()),
        "verify_s": verified,
        "network_share": (result.network_time_s or 0.0) / result.time_s,
        "simulate_s": simulated,
        "ratio": verified / simulated,
    }


def measure_spread(base: Path, rays: int, limit: float) -> dict[str, Any]:
    """Return the cost at so many rays and the peak memory (MiB) of this process."""
    coarse = read(base)
    # The field of view stays that of the coarse scan: the finer one shows the same walls.
    problem = question(spread(coarse, rays), default_field_of_view(coarse.rays), SMALLER)
    result = measure(problem, limit)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return result | {"peak_mib": peak / (2**20 if sys.platform == "darwin" else 2**10)}


def in_own_process(base: Path, rays: int, limit: float) -> dict[str, Any]:
    """Measure in a process of its own, so that its peak memory is its own."""
    command = [sys.executable, "-m", "bench.proofs", "--one", str(rays)]
    command += ["--base", str(base), "--limit", str(limit)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, cwd=ONNX.parent)
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def exponent(rays: list[float], costs: list[float]) -> float | None:
    """Return the exponent k of the power law c * rays^k that fits best (least squares, logs)."""
    return float(np.polyfit(np.log(rays), np.log(costs), 1)[0]) if len(rays) > 1 else None


COLUMNS = (
    ("rays", "6d"), ("verdict", ">8"), ("leaves", "7d"), ("verify_s", "9.3f"),
    ("simulate_s", "11.3f"), ("ratio", "7.2f"), ("network_share", "14.2f"), ("peak_mib", "9.0f"),
)  # fmt: skip


def show(name: str, results: Iterator[dict[str, Any]], as_json: bool) -> list[dict[str, Any]]:
    """Print results as they come, as a table or one JSON object each."""
    kept, columns = [], COLUMNS
    for result in results:
        kept.append(result)
        if as_json:
            print(json.dumps({"table": name, **result}), flush=True)
            continue
        if len(kept) == 1:
            columns = tuple(c for c in COLUMNS if c[0] in result)
            widths = (f"{c:>{len(format(0, f)) if f[0] != '>' else 8}}" for c, f in columns)
            print(f"\n{name}\n{'controller':28} " + " ".join(widths))
        figures = (format(result[c], f) for c, f in columns)
        print(f"{result['controller']:28} " + " ".join(figures), flush=True)
    return kept


def ratios(files: list[Path], limit: float) -> Iterator[dict[str, Any]]:
    """Measure each controller."""
    for file in files:
        controller = read(file)
        problem = question(controller, default_field_of_view(controller.rays))
        yield {"controller": file.stem, **measure(problem, limit)}


def against_rays(base: Path, rays: list[int], limit: float) -> Iterator[dict[str, Any]]:
    """Measure one network at each number of rays."""
    for count in rays:
        yield {"controller": f"{base.stem} spread", **in_own_process(base, count, limit)}


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("controllers", nargs="*", type=Path)
    parser.add_argument("--rays", nargs="+", type=int, default=list(RAYS))
    parser.add_argument("--base", type=Path, default=BASE, help="network to spread over the rays")
    parser.add_argument(
        "--limit", type=float, default=300.0, help="wall-clock seconds for one proof"
    )
    parser.add_argument("--skip", choices=["ratios", "rays"], help="leave out one table")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    base = given.base.resolve()
    if given.one is not None:
        print(json.dumps(measure_spread(base, given.one, given.limit)))
        return
    if given.skip != "ratios":
        files = given.controllers or sorted(ONNX.glob("*.onnx"))
        show("verify over simulate", ratios(files, given.limit), given.json)
    if given.skip == "rays":
        return
    results = show("against rays", against_rays(base, given.rays, given.limit), given.json)
    proved = [r for r in results if r["verdict"] == "unsat"]
    rays = [r["rays"] for r in proved]
    fitted = {c: exponent(rays, [r[c] for r in proved]) for c in ("verify_s", "leaves", "ratio")}
    if given.json:
        print(json.dumps({"table": "exponents", **fitted}))
    else:
        print(
            "\nexponents: " + ", ".join(f"{c} {k:.2f}" for c, k in fitted.items() if k is not None)
        )


if __name__ == "__main__":
    main()

"""How well the printed formats agree with the simulator, and what printing them costs.

    python -m bench.formats [CONTROLLER...] [--only hybrid|unrolled|vnnlib|cost]
                              [--whole N] [--json]

CONTROLLER: ONNX files; default: all in onnx/ that have an instance of full_range.

Hybrid: the files are read back and run by the tests' readers and executor, which share nothing
with the printers. The native JSON form is compared step by step, at the starts on both sides of
every wall jump: neighbours 0.1 mm apart in the start range from which some ray first meets
different walls. Whole runs of 70 steps, in all formats, from both sides of N jumps (default:
all). Both also from three fixed starts. Unrolled: the general graph on 1000 starts, float32 in
onnxruntime and float64 in the reference evaluator. VNN-LIB: every emitted 2.0 file through the
official parser. Cost: processor time of an export to all formats, of a committed instance and of
1081 rays with 128x128 neurons.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np
import onnxruntime
from onnx.reference import ReferenceEvaluator

import vnnlib
from generator.gzipped import unpacked
from generator.hybrid.export import FORMATS, Exporter, hybrid_files
from generator.instances import ControllerFile, Question, make_instance
from generator.unrolled.general import general_graph
from generator.unrolled.graph import Task
from generator.unrolled.questions import STEPS
from generator.unrolled.starts import Drive, start_sets
from racecar.closed_loop import State, simulate
from racecar.controller import Controller, Layer, save_controller
from racecar.experiment import default_field_of_view
from racecar.instance import Instance, load_instance, load_instance_controller
from racecar.polygon import Array, Polygon
from racecar.safety import Property

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "generator" / "hybrid"))
from hybrid_readers import read_flowstar, read_json, read_spaceex  # noqa: E402
from hybrid_runner import Runner, periods  # noqa: E402
from test_hybrid_verisig import Composed  # noqa: E402

#: Neighbours in the start range whose readings are compared, and by how much a reading jumps (m).
GRID, JUMP = 2001, 0.05
#: Starts that are always tried (s, m).
FIXED = (0.65, 0.75, 0.85)
STATES = ("s", "f", "v", "theta")


def instance_of(controller: Path) -> tuple[Instance, Controller]:
    """Return the instance of the whole start range, and the controller."""
    path = ROOT / f"benchmarks/full_range/json/{controller.stem}.full_range.clearance.json"
    instance = load_instance(path)
    return instance, load_instance_controller(instance, path)


def trace(instance: Instance, controller: Controller, s: float) -> dict[str, Array]:
    """Return the simulated run from s, ``[steps + 1]`` each; it is not cut where it is unsafe."""
    nowhere = Polygon.from_constraints([[1.0, 0.0, -1e6]])
    safety = Property("nowhere", ((nowhere,),) * len(instance.plant.frames))
    runs = simulate(
        instance.make_plant(), controller.steering_rows, safety, State.start(s), instance.steps,
        record=True,
    )  # fmt: skip
    assert runs.trace is not None
    return {name: values[0] for name, values in runs.trace.items()}


def beside_jumps(instance: Instance, controller: Controller) -> list[tuple[float, float]]:
    """Return neighbours in the start range from which a ray first meets different walls."""
    plant, starts = instance.make_plant(), np.linspace(0.65, 0.85, GRID)
    state, seen, pairs = State.start(starts), np.zeros(GRID - 1, dtype=bool), []
    for _ in range(instance.steps):
        scan = plant.scan_rows(state)
        jumps = np.abs(np.diff(scan, axis=1)).max(axis=0) > JUMP
        pairs += [(starts[i].item(), starts[i + 1].item()) for i in np.flatnonzero(jumps & ~seen)]
        seen |= jumps
        state = plant.advance(plant.drive(state, controller.steering_rows(scan))[0])
    return pairs


def angle(values: dict[str, float]) -> float:
    """Return the heading (rad), up to whole turns where only cosine and sine are there."""
    if "clock" in values:  # Verisig's names
        return values["y4"]
    if "theta" in values:
        return values["theta"]
    return float(np.arctan2(values["st"], values["ct"]))


def apart(values: dict[str, float], simulated: dict[str, Array], k: int) -> float:
    """Return the largest difference of a state (m, m/s, rad) at control instant k."""
    at = [
        values[x] if x in values else values[y] for x, y in (("s", "y1"), ("f", "y2"), ("v", "y3"))
    ]
    turned = (angle(values) - simulated["theta"][k] + np.pi) % (2 * np.pi) - np.pi
    rest = [x - simulated[name][k] for x, name in zip(at, STATES, strict=False)]
    # The first mode of the polynomial forms turns the heading, and after the last period the
    # automata do not change the frame.
    return float(np.max(np.abs([*rest, turned if k else 0.0])))


def native_steps(runner: Runner, simulated: dict[str, Array], steps: int) -> float:
    """Return the largest difference of one step, over the steps of a run."""
    worst = 0.0
    for k in range(steps - 1):
        given = {name: float(simulated[name][k]) for name in STATES}
        visits = runner.run(runner.middle(**given, k=float(k)), "scan")
        worst = max(worst, apart(next(islice(periods(visits), 1, None)), simulated, k + 1))
    return worst


def whole_run(runner: Runner, start: str, s: float, simulated: dict[str, Array]) -> float:
    """Return the largest difference of a whole run."""
    visits = runner.run(runner.middle(**{start: s}))
    return max(apart(values, simulated, k) for k, values in enumerate(periods(visits)))


def runners(instance: Instance, controller: Controller) -> dict[str, tuple[Runner, str]]:
    """Return what runs each format's files, and what the format calls s."""
    files = {form: hybrid_files(instance, controller, form, zipped=False) for form in FORMATS}
    space = read_spaceex(*(files["spaceex"][x].decode() for x in (".xml", ".cfg")))
    return {
        "json": (Runner(read_json(files["json"][".automaton.json"]), tolerance=1e-13), "s"),
        "flowstar": (Runner(read_flowstar(files["flowstar"][".model"].decode())), "s"),
        "spaceex": (Runner(space), "s"),
        "verisig": (Composed(files["verisig"]).runner, "y1"),
    }


def hybrid(file: Path, whole: int | None) -> Iterator[dict[str, Any]]:
    """Compare the hybrid formats of a controller with the simulator."""
    instance, controller = instance_of(file)
    ready, pairs = runners(instance, controller), beside_jumps(instance, controller)
    starts = [*FIXED, *(s for pair in pairs for s in pair)]
    began = process_time()
    worst = max(
        native_steps(ready["json"][0], trace(instance, controller, s), instance.steps)
        for s in starts
    )
    row = {"controller": file.stem, "jumps": len(pairs)}
    yield row | {
        "what": "json, each step", "starts": len(starts), "worst": worst,
        "cpu_s": process_time() - began,
    }  # fmt: skip
    chosen = [*FIXED, *(s for pair in pairs[:whole] for s in pair)]
    for form, (runner, start) in ready.items():
        began = process_time()
        found = [whole_run(runner, start, s, trace(instance, controller, s)) for s in chosen]
        yield row | {
            "what": f"{form}, 70 steps", "starts": len(found), "worst": max(found),
            "cpu_s": process_time() - began,
        }  # fmt: skip


def margins(task: Task, starts: Array) -> Array:
    """Return the margins after each step, NaN after the first that is not positive."""
    plant, state, found = task.plant, State.start(*starts.T), []
    going = plant.margin(task.safety, state) > 0
    for _ in range(task.steps):
        after, _ = plant.drive(state, task.controller.steering_rows(plant.scan_rows(state)))
        now = plant.margin(task.safety, after)
        found.append(np.where(going, now, np.nan))
        going &= now > 0
        state = plant.advance(after)
    return np.array(found).T


def unrolled(file: Path, count: int = 1000) -> Iterator[dict[str, Any]]:
    """Compare the general graphs of a controller with the simulator."""
    instance, controller = instance_of(file)
    drive = Drive(controller, instance.make_plant(), instance.make_property())
    for steps in STEPS:
        sets = list(start_sets(drive, steps))
        if not sets:
            continue
        task = drive.task(sets[0], steps)
        random = np.random.default_rng(steps)
        drawn = random.uniform(task.start.lower, task.start.upper, size=(count, 4))
        starts = np.clip(drawn.astype(np.float32), sets[0].box.lower, sets[0].box.upper)
        wanted = margins(task, starts.astype(float))
        single = onnxruntime.InferenceSession(general_graph(task).SerializeToString())
        twin = ReferenceEvaluator(general_graph(task, np.float64))
        off = [
            np.nanmax(np.abs(np.where(np.isnan(wanted), np.nan, values - wanted)), axis=1)
            for values in (
                single.run(None, {"start": starts})[0],
                twin.run(None, {"start": starts.astype(float)})[0],
            )
        ]
        yield {
            "controller": file.stem, "k": steps, "starts": count, "float32": float(off[0].max()),
            "float32_in_1e-4": float(np.mean(off[0] <= 1e-4)), "float64": float(off[1].max()),
        }  # fmt: skip


def parsed() -> Iterator[dict[str, Any]]:
    """Give every emitted 2.0 file to the official parser."""
    for category in ("open_loop", "unrolled"):
        files = sorted((ROOT / "vnnlib" / category / "2.0").glob("*.vnnlib.gz"))
        for path in files:
            vnnlib.parse_query_string(unpacked(path).decode())
        yield {"category": category, "taken": len(files)}


def cost(files: list[Path]) -> Iterator[dict[str, Any]]:
    """Measure an export to all formats."""
    for file in files:
        yield {"controller": file.stem, **_cost(*instance_of(file))}
    random, rays, hidden = np.random.default_rng(0), 1081, 128
    shapes = [(hidden, rays), (hidden, hidden), (1, hidden), (1, 1)]
    layers = [
        Layer(
            (random.normal(size=shape) / 30).astype(np.float32), np.zeros(shape[0], np.float32), a
        )
        for shape, a in zip(shapes, ("tanh", "tanh", "tanh", "linear"), strict=True)
    ]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "random_L1081_128x128.onnx"
        save_controller(Controller(tuple(layers)), path)
        file, view = ControllerFile.load(path), default_field_of_view(rays)
        question = Question("scan", "test", ("0.65", "0.85"))
        instance = make_instance(question, file, view, path.with_suffix(".json"))
        yield {"controller": path.stem, **_cost(instance, file.controller)}


def _cost(instance: Instance, controller: Controller) -> dict[str, Any]:
    found: dict[str, Any] = {}
    exporter = Exporter()
    for form in FORMATS:
        began = process_time()
        files = exporter.files(instance, controller, form)
        found[form] = process_time() - began
        found[f"{form}_kb"] = sum(map(len, files.values())) / 1000
    return found | {"all": sum(found[form] for form in FORMATS)}


def show(rows: Iterator[dict[str, Any]], as_json: bool) -> None:
    """Print results as they come."""
    for row in rows:
        if as_json:
            print(json.dumps(row), flush=True)
        else:
            texts = (f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
            print("  ".join(texts), flush=True)


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("controllers", nargs="*", type=Path)
    parser.add_argument("--only", choices=["hybrid", "unrolled", "vnnlib", "cost"])
    parser.add_argument("--whole", type=int, help="beside so many jumps, runs are whole")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    names = (ROOT / "benchmarks/full_range/json").glob("*.full_range.clearance.json")
    default = [ROOT / f"onnx/{path.name.split('.')[0]}.onnx" for path in sorted(names)]
    files: list[Path] = given.controllers or default
    tables: dict[str, Callable[[], Iterator[dict[str, Any]]]] = {
        "cost": lambda: cost(files),
        "vnnlib": parsed,
        "unrolled": lambda: (row for file in files for row in unrolled(file)),
        "hybrid": lambda: (row for file in files for row in hybrid(file, given.whole)),
    }
    for name, table in tables.items():
        if given.only in (None, name):
            show(table(), given.json)


if __name__ == "__main__":
    main()

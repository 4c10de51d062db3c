"""Learning curves of recipes for robust controllers, on the paper's measure.

    python -m bench.robust_study --work FOLDER [--out docs/robust_study] [RECIPE ...]

Each recipe is trained with seeds 1 to 3, one after the other; what is done is kept in FOLDER,
and a run that was stopped goes on. Then OUT.csv holds the curves and OUT.png shows them.
The measure: share of runs that are safe as the paper judges, under its pattern (5 rays drawn
to be missing in the turn, noise up to 0.2 m), 1,024 runs at each point of a curve and 20,000 at
the end; after that also the least margin over all single rays and pairs of rays missing.
"""

# ruff: noqa: E402 (the environment must be set before NumPy is imported)

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import csv
import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import LogLocator

from generator.hyperparams import AnyHyperparameters, Hyperparameters, load_hyperparameters
from generator.instances import benchmark_plant
from generator.robust import train as robust
from generator.seeds import CONTROLLER, CURVE, RECORD, Trained, try_seed
from generator.setups import Setup, parse_setup
from racecar.controller import load_controller, write_whole
from racecar.experiment import Experiment, RandomStarts, run_experiment
from racecar.faults import FAULTS
from racecar.raysets import all_sets, least_margins
from racecar.safety import named_property
from racecar.summary import wilson_interval

SEEDS = (1, 2, 3)
RUNS = 20_000
#: A budget at which recipes differ and that a laptop spends in seconds.
SMALL = {"rounds": 10, "gradient_steps": 400}


@dataclass(frozen=True)
class Recipe:
    """What differs from the package's hyper-parameters."""

    family: str
    changes: dict[str, Any] = field(default_factory=dict)
    faults: dict[str, Any] = field(default_factory=dict)
    seeds: tuple[int, ...] = SEEDS

    @property
    def setup(self) -> Setup:
        return parse_setup(f"{self.family}_C1")

    def parameters(self) -> AnyHyperparameters:
        found = load_hyperparameters(self.setup.algorithm)
        data = found.model_dump(exclude_none=True) | self.changes
        if self.faults:
            data["faults"] |= self.faults
        return type(found).model_validate(data)


_SMALL_NET, _WIDE_NET = "ROBUST_L21_64x64", "ROBUST_L21_128x128"
RECIPES = {
    "no faults": Recipe(_SMALL_NET, SMALL, {"missing": 0, "noise": 0.0, "jitter": 0.0}),
    "plain": Recipe(_SMALL_NET, SMALL | {"gain_penalty": 0.0}),
    "gain penalty": Recipe(_SMALL_NET, SMALL),
    "curriculum": Recipe(_SMALL_NET, SMALL, {"curriculum_rounds": 5}),
    "adversarial": Recipe(_SMALL_NET, SMALL, {"mined": 0.3}),
    "wide": Recipe(_WIDE_NET, SMALL),
    "large budget": Recipe(_SMALL_NET),
    "TD3 with faults": Recipe(
        "TD3_L21_64x64", {"n_timesteps": 40_000, "env_kwargs": {"faults": "paper"}}
    ),
}


def train_all(name: str, recipe: Recipe, work: Path, done_only: bool) -> list[dict[str, Any]]:
    """Train a recipe's seeds; return rows of their curves, the last of each measured finely.

    The CPU time is that of this process: of a training that was stopped, what came after.
    """
    rows: list[dict[str, Any]] = []
    for seed in recipe.seeds:
        folder = work / name.replace(" ", "_") / f"seed_{seed}"
        clock = folder / "cpu_seconds.json"
        if done_only and not (folder / RECORD).exists():
            continue
        fresh = not (folder / RECORD).exists()
        began = time.process_time()
        try_seed(recipe.setup, seed, recipe.parameters(), folder, _train)
        if fresh:
            write_whole(clock, json.dumps(time.process_time() - began).encode())
        final = folder / "final.json"
        if not final.exists():
            write_whole(final, json.dumps(measure(folder / CONTROLLER, recipe.setup)).encode())
        with (folder / CURVE).open() as file:
            curve = list(csv.DictReader(file))
        spent = json.loads(clock.read_text()) if clock.exists() else math.nan
        past, total = 0.0, sum(float(point["seconds"]) for point in curve)
        for point in curve:
            past += float(point["seconds"])
            share = float(point["paper_safe_fraction"])
            rows.append(_row(name, seed, round(past / total * spent, 1), share, robust.CURVE_RUNS))
        last = json.loads(final.read_text())
        rows.append(_row(name, seed, round(spent, 1), last["safe"] / RUNS, RUNS) | last)
        print(name, seed, f"{spent:.0f} s", last, flush=True)
    return rows


def _row(name: str, seed: int, seconds: float, share: float, runs: int) -> dict[str, Any]:
    low, high = wilson_interval(round(share * runs), runs)
    return {
        "recipe": name, "seed": seed, "cpu_seconds": seconds, "runs": runs,
        "safe_fraction": share, "low": round(low, 5), "high": round(high, 5),
    }  # fmt: skip


def _train(setup: Setup, seed: int, parameters: AnyHyperparameters, folder: Path) -> Trained:
    if isinstance(parameters, Hyperparameters):
        from generator.train import train  # noqa: PLC0415 (slow to import)

        plant = benchmark_plant(setup.rays, setup.field_of_view)
        share = robust.paper_safe_fraction
        return train(
            setup, seed, parameters, folder,
            measure=lambda controller: {"paper_safe_fraction": share(controller, plant)},
        )  # fmt: skip
    return robust.train(setup, seed, parameters, folder, chunk=2 if parameters.rounds < 20 else 5)


def measure(controller: Path, setup: Setup) -> dict[str, Any]:
    """Return how a controller does at the end."""
    steer = load_controller(controller).steering_rows
    plant = benchmark_plant(setup.rays, setup.field_of_view)
    safety = named_property("clearance", plant.track)
    experiment = Experiment(plant, safety, RandomStarts(), FAULTS["paper"], RUNS, seed=0)
    outcome = run_experiment(experiment, steer)
    margins = [least_margins(plant, steer, all_sets(setup.rays, size)) for size in (0, 1, 2)]
    return {
        "safe": int(outcome.safe.sum()),
        "nominal_margin": float(margins[0].min()),
        "worst_single": float(margins[1].min()),
        "worst_pair": float(margins[2].min()),
        "unsafe_sets": int(np.sum(margins[1] <= 0) + np.sum(margins[2] <= 0)),
    }


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw unsafe shares over CPU time: mean of the seeds, and their range."""
    figure, axes = plt.subplots(figsize=(7.5, 4.5), layout="constrained")
    for index, name in enumerate(dict.fromkeys(row["recipe"] for row in rows)):
        mine = [row for row in rows if row["recipe"] == name]
        mine = [row for row in mine if math.isfinite(row["cpu_seconds"])]
        if not mine:
            continue
        seeds = list(dict.fromkeys(row["seed"] for row in mine))
        curves = [[r for r in mine if r["seed"] == s and r["runs"] != RUNS] for s in seeds]
        color = f"C{index}"
        if curves[0]:
            count = min(map(len, curves))
            x = np.mean([[r["cpu_seconds"] for r in c[:count]] for c in curves], axis=0)
            y = np.array([[1 - r["safe_fraction"] for r in c[:count]] for c in curves])
            y = np.maximum(y, 0.5 / robust.CURVE_RUNS)
            axes.plot(x, y.mean(axis=0), color=color, label=name)
            axes.fill_between(x, y.min(axis=0), y.max(axis=0), color=color, alpha=0.15, lw=0)
        for number, row in enumerate(r for r in mine if r["runs"] == RUNS):
            label = None if curves[0] or number else name
            share = max(1 - row["safe_fraction"], 0.5 / RUNS)
            axes.plot(row["cpu_seconds"], share, "o", ms=4, color=color, label=label)
    axes.axhline(0.17, color="0.4", lw=0.8, ls=":")
    axes.text(0.99, 0.172, "best of the paper", transform=axes.get_yaxis_transform(),
              ha="right", va="bottom", fontsize=8)  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
        axis.set_tick_params(labelsize=8)
    axes.set_xlabel("CPU time of the training (s)")
    axes.set_ylabel("unsafe runs under the paper's faults (share)")
    axes.legend(fontsize=8, loc="lower left")
    axes.grid(alpha=0.3, which="both", lw=0.4)
    figure.savefig(path, dpi=150, metadata={"Software": None})


def main() -> None:
    """Train what is asked for, write the table and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("recipes", nargs="*", choices=[[], *RECIPES], metavar="RECIPE")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("docs/robust_study"))
    parser.add_argument("--done-only", action="store_true", help="use what FOLDER holds, no more")
    given = parser.parse_args()
    rows = []
    for name in given.recipes or RECIPES:
        rows += train_all(name, RECIPES[name], given.work, given.done_only)
    fields = list(dict.fromkeys(key for row in rows for key in row))
    with given.out.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, fields, lineterminator="\n", restval="")
        writer.writeheader()
        for row in rows:
            known = math.isfinite(row["cpu_seconds"])
            writer.writerow(row | {"cpu_seconds": row["cpu_seconds"] if known else ""})
    draw(rows, given.out.with_suffix(".png"))


if __name__ == "__main__":
    main()

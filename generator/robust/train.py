"""Robust training with the same interface as the other: seeded, resumable, with a curve.

Only whole chunks of rounds are kept in the checkpoint: interrupted, the training does the
rounds since then again, and ends in the same bytes.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from generator.hyperparams.robust import RobustHyperparameters
from generator.instances import benchmark_plant
from generator.nominal import drive_nominal
from generator.robust.dagger import Dagger
from generator.robust.student import Student
from generator.seeds import CHECKPOINT, Trained, training_settings
from generator.setups import Setup
from racecar.closed_loop import Plant
from racecar.controller import Controller, write_whole
from racecar.env import MAX_STEERING
from racecar.errors import BadInput
from racecar.experiment import Experiment, RandomStarts, run_experiment
from racecar.faults import FAULTS
from racecar.safety import named_property

#: Rounds between checkpoints.
CHUNK = 5
#: Runs under the paper's faults behind each point of the curve, and their seed.
CURVE_RUNS, CURVE_SEED = 1024, 1
LIBRARIES = ("torch", "numpy")
#: How far (rad) the exported network may stray from the trained one: float32 rounding.
EXPORT_TOLERANCE = 1e-5


def train(
    setup: Setup,
    seed: int,
    parameters: RobustHyperparameters,
    work: Path,
    report: Callable[[int, int], None] = lambda done, total: None,
    chunk: int = CHUNK,
) -> Trained:
    """Train one seed of a setup, from its checkpoint in ``work`` if there is one.

    report(done, total) is called after each round; chunk: rounds between checkpoints. Raises
    BadInput if the checkpoint is broken or was made with other settings.
    """
    torch.set_num_threads(1)
    libraries = {name: version(name) for name in LIBRARIES}
    settings = training_settings(setup, seed, parameters, libraries)
    plant = benchmark_plant(setup.rays, setup.field_of_view)
    dagger, curve = Dagger(plant, setup.hidden, parameters, seed), []
    checkpoint = work / CHECKPOINT
    if checkpoint.exists():
        curve = _restore(dagger, settings, checkpoint)
    while dagger.rounds < parameters.rounds:
        began = time.perf_counter()
        for _ in range(min(chunk, parameters.rounds - dagger.rounds)):
            error, gain = dagger.round()
            report(dagger.rounds, parameters.rounds)
        controller = dagger.student.controller({})
        nominal = drive_nominal(controller, setup.field_of_view)
        curve.append(
            {
                "rounds": dagger.rounds,
                "gradient_steps": dagger.rounds * parameters.gradient_steps,
                "squared_error": error,
                "gain": MAX_STEERING * gain,
                "paper_safe_fraction": paper_safe_fraction(controller, plant),
                "nominal_safe_fraction": nominal.safe_fraction,
                "nominal_margin": nominal.margin,
                "seconds": round(time.perf_counter() - began, 1),
            }
        )
        _save(dagger, curve, settings, checkpoint)
    metadata = {
        "setup": setup.family,
        "algorithm": setup.algorithm,
        "seed": str(seed),
        "rounds": str(parameters.rounds),
        "hyperparameters_sha256": parameters.sha256(),
    }
    controller = dagger.student.controller(metadata | libraries)
    stray = export_error(dagger.student, controller)
    if not stray <= EXPORT_TOLERANCE:
        raise RuntimeError(f"the exported network strays {stray} rad from the trained one")
    nominal = drive_nominal(controller, setup.field_of_view)
    return Trained(controller, nominal, curve, libraries, stray)


def paper_safe_fraction(controller: Controller, plant: Plant) -> float:
    """Return the share of runs under the paper's faults that are safe as the paper judges."""
    safety = named_property("clearance", plant.track)
    experiment = Experiment(
        plant, safety, RandomStarts(), FAULTS["paper"], CURVE_RUNS, seed=CURVE_SEED
    )
    return float(np.mean(run_experiment(experiment, controller.steering_rows).safe))


def export_error(student: Student, controller: Controller, scans: int = 10_000) -> float:
    """Return the largest difference (rad) between network and controller on random scans."""
    scan = np.random.default_rng(0).uniform(0, 5, (scans, controller.rays)).astype(np.float32)
    with torch.no_grad():
        expected = MAX_STEERING * student(torch.as_tensor(scan)).numpy().astype(float)
    return float(np.abs(controller.steering(scan.astype(float)) - expected).max())


def _save(
    dagger: Dagger, curve: list[dict[str, float]], settings: dict[str, Any], path: Path
) -> None:
    content = io.BytesIO()
    torch.save(
        {
            "settings": settings,
            "student": dagger.student.state_dict(),
            "optimizer": dagger.optimizer.state_dict(),
            "random": dagger.random.bit_generator.state,
            "rounds": dagger.rounds,
            "seen": dagger.seen,
            "curve": curve,
        },
        content,
    )
    write_whole(path, content.getvalue())


def _restore(dagger: Dagger, settings: dict[str, Any], path: Path) -> list[dict[str, float]]:
    """Bring a fresh training to the state of a checkpoint; return the curve so far."""
    try:
        state = torch.load(path, weights_only=True)
        other = state["settings"] != settings
    except Exception:  # unpickling raises whatever it likes
        raise BadInput(f"{path}: not a checkpoint of this version; remove it") from None
    if other:
        raise BadInput(
            f"{path.parent}: its training was begun with other hyper-parameters, setup, seed or "
            "libraries; choose another --work or remove it"
        )
    dagger.student.load_state_dict(state["student"])
    dagger.optimizer.load_state_dict(state["optimizer"])
    dagger.random.bit_generator.state = state["random"]
    dagger.rounds, dagger.seen = state["rounds"], state["seen"]
    curve: list[dict[str, float]] = state["curve"]
    return curve

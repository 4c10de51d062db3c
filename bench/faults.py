"""Speed of the closed loop with faults on one core, beside the same loop without.

    python -m bench.faults [--json]

21 rays, a 64x64 controller, 1,000,000 control steps under the paper's pattern: once with the
random numbers drawn in order (``racecar.faults``), once with those that belong to run and step
(``racecar.faultmodels``). CPU time of the process; each round measures all three.
"""

# ruff: noqa: E402 (the environment must be set before NumPy is imported)

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import json
import sys
from pathlib import Path
from statistics import median
from time import process_time

from generator.instances import benchmark_plant
from racecar.controller import RuntimeSteer
from racecar.experiment import Experiment, RandomStarts, default_field_of_view, run_experiment
from racecar.faultmodels.named import named_faults
from racecar.faults import FAULTS
from racecar.safety import named_property

CONTROLLER = Path(__file__).parents[1] / "onnx" / "ROBUST_L21_64x64_C1.onnx"
STEPS, ROUNDS = 1_000_000, 3
MODELS = {
    "none": FAULTS["none"],
    "paper": FAULTS["paper"],
    "paper_pattern": named_faults("paper_pattern"),
}


def measure() -> dict[str, dict[str, float]]:
    """Return, for each kind of faults, the CPU seconds of STEPS steps and the ratio to none."""
    steer = RuntimeSteer(CONTROLLER)
    plant = benchmark_plant(steer.rays, default_field_of_view(steer.rays))
    safety = named_property("clearance", plant.track)
    times: dict[str, list[float]] = {name: [] for name in MODELS}
    for _ in range(ROUNDS):
        for name, faults in MODELS.items():
            experiment = Experiment(plant, safety, RandomStarts(), faults, -(-STEPS // 70))
            begin = process_time()
            outcome = run_experiment(experiment, steer)
            spent = process_time() - begin
            times[name].append(spent * STEPS / outcome.steps_driven)
    seconds = {name: median(values) for name, values in times.items()}
    return {
        name: {"seconds_per_million_steps": value, "ratio_to_none": value / seconds["none"]}
        for name, value in seconds.items()
    }


def main() -> None:
    """Print the results, as text or (``--json``) one JSON object."""
    result = measure()
    if "--json" in sys.argv[1:]:
        print(json.dumps(result))
        return
    for name, values in result.items():
        print(f"{name:14} {values['seconds_per_million_steps']:6.2f} s per 1,000,000 steps, "
              f"{values['ratio_to_none']:.2f} times as long as without faults")  # fmt: skip


if __name__ == "__main__":
    main()

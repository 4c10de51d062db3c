"""The paper's Table 2: safe outcomes in its two environments, beside modelled ones.

The paper drove the real car ten times per controller, once with the reflective surfaces of the
hallway covered ("modified") and once as it was ("unmodified"). Here both are fault models.
"""

from __future__ import annotations

from dataclasses import dataclass

from racecar.closed_loop import Steer
from racecar.experiment import Experiment, RandomStarts, paper_plant, run_experiment
from racecar.faultmodels.named import named_faults
from racecar.safety import named_property
from racecar.summary import wilson_interval

ENVIRONMENTS = ("modified", "unmodified")

#: Safe runs of ten, in (modified, unmodified): Table 2 of Ivanov et al., HSCC 2020.
PAPER: dict[str, tuple[int, int]] = {
    "DDPG_L21_64x64_C1": (9, 0),
    "DDPG_L21_64x64_C2": (9, 2),
    "DDPG_L21_64x64_C3": (10, 8),
    "DDPG_L21_128x128_C1": (10, 8),
    "DDPG_L21_128x128_C2": (7, 4),
    "DDPG_L21_128x128_C3": (9, 0),
    "TD3_L21_64x64_C1": (8, 9),
    "TD3_L21_64x64_C2": (10, 9),
    "TD3_L21_64x64_C3": (10, 9),
    "TD3_L21_128x128_C1": (9, 9),
    "TD3_L21_128x128_C2": (9, 9),
    "TD3_L21_128x128_C3": (9, 9),
}
PAPER_RUNS = 10


@dataclass(frozen=True)
class Entry:
    """A controller in one environment; paper: safe runs of ten there, None where not reported."""

    environment: str
    runs: int
    safe: int
    interval: tuple[float, float]
    paper: int | None


def table_row(steer: Steer, rays: int, name: str, runs: int, seed: int) -> list[Entry]:
    """Run a controller in both environments from the paper's random starts.

    Safe is what the paper calls so: no crash seen at a control instant.
    """
    plant = paper_plant(rays)
    safety = named_property("clearance", plant.track)
    row = []
    for place, environment in enumerate(ENVIRONMENTS):
        experiment = Experiment(
            plant, safety, RandomStarts(), named_faults(environment), runs, seed=seed
        )
        safe = int(run_experiment(experiment, steer).safe.sum())
        paper = PAPER[name][place] if name in PAPER else None
        row.append(Entry(environment, runs, safe, wilson_interval(safe, runs), paper))
    return row

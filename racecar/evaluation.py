"""The scored protocol: the same faults for every controller, so that numbers can be compared.

A protocol is a fixed list of fault models, with fixed numbers of runs and fixed seeds, and a
version; whatever changes a result is a new version. Two results may be compared if their
``protocol`` and ``protocol_sha256`` are the same.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from racecar.closed_loop import Plant, Steer
from racecar.data import Data
from racecar.experiment import (
    STEPS,
    EvenStarts,
    Experiment,
    Outcome,
    RandomStarts,
    paper_plant,
    run_experiment,
)
from racecar.faultmodels.named import named_faults
from racecar.faults import FAULTS
from racecar.polygon import Array
from racecar.raysets import all_sets, least_margins
from racecar.safety import named_property
from racecar.summary import wilson_interval


@dataclass(frozen=True)
class Protocol:
    """What is run.

    scored: names of fault models, each run ``runs`` times from the paper's random starts with
    ``seed``; the nominal drive runs ``nominal_runs`` even starts without faults; ray_starts: s
    (m) of the starts from which every ray, and every pair of rays, is missing once.
    """

    version: int
    scored: tuple[str, ...]
    runs: int
    seed: int
    nominal_runs: int
    ray_starts: tuple[float, ...]

    def sha256(self) -> str:
        """Return a hash of all that the protocol says, the fault models' contents included."""
        models = {name: named_faults(name).sha256() for name in self.scored}
        said = [
            self.version,
            models,
            self.runs,
            self.seed,
            self.nominal_runs,
            self.ray_starts,
            STEPS,
        ]
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


PROTOCOL = Protocol(
    version=1,
    scored=(
        "paper_pattern",
        "one_ray",
        "persistent",
        "per_scan",
        "dropout",
        "block",
        "reflective",
        "bounded_noise",
        "modified",
        "unmodified",
        "mixture",
    ),
    runs=10_000,
    seed=20200422,
    nominal_runs=1001,
    ray_starts=(0.65, 0.7, 0.75, 0.8, 0.85),
)

Interval = tuple[float, float]


class Share(Data):
    """How many runs were safe; interval: 95 % Wilson confidence interval of the share."""

    safe: int
    fraction: float
    interval: Interval


class Scenario(Data):
    """What happened under one fault model.

    sampled: judged at control instants as the paper does; continuous: at all times. margin_*
    (m, continuous time): the least, and the one that 1 % of the runs fall short of.
    """

    faults: str
    faults_sha256: str | None
    runs: int
    sampled: Share
    continuous: Share
    margin_min: float
    margin_1_percent: float


class RaySets(Data):
    """Every set of so many rays missing in the turn, from a few starts, without noise.

    margin_min: m, continuous time; worst: the rays (from 0) whose absence leaves the least.
    """

    size: int
    sets: int
    safe: int
    margin_min: float
    worst: tuple[int, ...]


class Evaluation(Data):
    """A controller's result.

    score: percent, the mean over ``scenarios`` of the fraction safe in continuous time. runs and
    official: a shortened evaluation is not official and not to be compared.
    """

    format: Literal["closedlap-evaluation"] = "closedlap-evaluation"
    protocol: int
    protocol_sha256: str
    official: bool
    controller: str
    controller_sha256: str
    rays: int
    score: float
    nominal: Scenario
    scenarios: tuple[Scenario, ...]
    ray_sets: tuple[RaySets, ...]
    seed: int


def evaluate(
    steer: Steer,
    rays: int,
    name: str,
    sha256: str,
    runs: int | None = None,
    progress: Callable[[int], None] | None = None,
    protocol: Protocol = PROTOCOL,
) -> Evaluation:
    """Evaluate a controller.

    steer: scans ``[rays, batch]`` (m) to steering ``[batch]`` (rad); name, sha256: of its file;
    runs: of each scenario instead of the protocol's (the result is then not official);
    progress: called with numbers of runs done.
    """
    plant = paper_plant(rays)
    safety = named_property("clearance", plant.track)
    count = runs or protocol.runs
    nominal = Experiment(plant, safety, EvenStarts(), FAULTS["none"], protocol.nominal_runs)
    scenarios = []
    for faults in protocol.scored:
        experiment = Experiment(
            plant, safety, RandomStarts(), named_faults(faults), count, seed=protocol.seed
        )
        outcome = run_experiment(experiment, steer, progress=progress)
        scenarios.append(_scenario(faults, named_faults(faults).sha256(), outcome))
    return Evaluation(
        protocol=protocol.version,
        protocol_sha256=protocol.sha256(),
        official=count == protocol.runs,
        controller=name,
        controller_sha256=sha256,
        rays=rays,
        score=100 * float(np.mean([x.continuous.fraction for x in scenarios])),
        nominal=_scenario("none", None, run_experiment(nominal, steer)),
        scenarios=tuple(scenarios),
        ray_sets=tuple(_ray_sets(plant, steer, size, protocol.ray_starts) for size in (1, 2)),
        seed=protocol.seed,
    )


def _scenario(faults: str, sha256: str | None, outcome: Outcome) -> Scenario:
    margin: Array = np.where(np.isnan(outcome.runs.margin), -math.inf, outcome.runs.margin)
    runs = len(outcome.start)
    return Scenario(
        faults=faults,
        faults_sha256=sha256,
        runs=runs,
        sampled=_share(int(outcome.safe.sum()), runs),
        continuous=_share(int(outcome.safe_continuous.sum()), runs),
        margin_min=float(margin.min()),
        margin_1_percent=float(np.quantile(margin, 0.01, method="lower")),
    )


def _share(safe: int, runs: int) -> Share:
    return Share(safe=safe, fraction=safe / runs, interval=wilson_interval(safe, runs))


def _ray_sets(plant: Plant, steer: Steer, size: int, starts: tuple[float, ...]) -> RaySets:
    gone = all_sets(plant.lidar.rays, size)
    margins = least_margins(plant, steer, gone, starts)
    worst = int(np.argmin(margins))
    return RaySets(
        size=size,
        sets=len(margins),
        safe=int(np.sum(margins > 0)),
        margin_min=float(margins[worst]),
        worst=tuple(int(ray) for ray in np.flatnonzero(gone[:, worst])),
    )

"""What the runs of an experiment show, in a few numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from racecar.experiment import Outcome


@dataclass(frozen=True)
class Summary:
    """What the runs of an experiment show; margins in metres.

    safe, safe_fraction: as the paper judges (Outcome.safe); safe_fraction_interval: the 95 %
    Wilson confidence interval for it; safe_fraction_continuous: at all times;
    margin_min: in continuous time; margin_min_sampled: at control instants; worst_run:
    the number of the run with the least margin, and its start in m, m/s and rad.
    """

    runs: int
    safe: int
    safe_fraction: float
    safe_fraction_interval: tuple[float, float]
    safe_fraction_continuous: float
    margin_min: float
    margin_min_sampled: float
    worst_run: int
    worst_start: dict[str, float]


def summarise(outcome: Outcome) -> Summary:
    """Return what the runs show."""
    runs, safe = len(outcome.start), int(outcome.safe.sum())
    worst = int(np.argmin(outcome.runs.margin))
    return Summary(
        runs=runs,
        safe=safe,
        safe_fraction=safe / runs,
        safe_fraction_interval=wilson_interval(safe, runs),
        safe_fraction_continuous=float(np.mean(outcome.safe_continuous)),
        margin_min=float(outcome.runs.margin[worst]),
        margin_min_sampled=float(outcome.runs.margin_sampled.min()),
        worst_run=worst,
        worst_start={
            name: float(getattr(outcome.start, name)[worst]) for name in ("s", "f", "v", "theta")
        },
    )


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the Wilson score interval for a share (Wilson 1927, JASA 22(158), 209-212)."""
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    share, weight = successes / trials, z * z / trials
    centre = (share + weight / 2) / (1 + weight)
    half = math.sqrt(weight * (share * (1 - share) + weight / 4)) / (1 + weight)
    # At a share of 0 or 1 one end is that share exactly; rounding must not leave it.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high

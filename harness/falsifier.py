"""The tool ``simulate``: look for a start from which the car enters the unsafe set.

It simulates batches of starts, random ones and ones near the best so far, with disturbances if
the instance has any, and says sat only if the strict check that judges witnesses passes. It
never says unsat.

Called as ``python -m harness.falsifier SPEC RESULTS TIMEOUT`` by tools/simulate/run_instance.sh.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import psutil

from harness.candidates import Candidates, crossed, disturbed
from harness.records import Verdict
from harness.replay import Replayer
from racecar.controller import write_whole
from racecar.errors import BadInput
from racecar.instance import Instance, load_instance
from racecar.polygon import Array
from racecar.witness import Witness, format_witness

#: Starts a round, rounds, and best starts that are kept from round to round.
LARGEST_BATCH, ROUNDS, ELITE = 512, 24, 8
#: With a disturbance the first round has at least so many.
_FIRST = 128
#: Of the timeout this share is used, less the time (seconds) that the process takes to end.
SHARE, ENDING_S = 0.9, 0.2
#: Of a batch at most this many starts are checked strictly, one by one.
_STRICT = 16


@dataclass(frozen=True)
class Box:
    """The initial set: bounds ``[4]`` in the order s, f, v, theta."""

    lower: Array
    upper: Array

    @property
    def width(self) -> Array:
        """The widths, ``[4]``."""
        return self.upper - self.lower

    def corners(self) -> Array:
        """Return the corners and the centre, each once: ``[n, 4]``."""
        ends = [sorted({low, high}) for low, high in zip(self.lower, self.upper, strict=True)]
        corners = [*product(*ends), tuple(self.lower + self.width / 2)]
        return self.clip(np.unique(np.array(corners), axis=0))

    def sample(self, count: int, random: np.random.Generator) -> Array:
        """Return ``count`` starts, one in each slice of every axis: ``[count, 4]``."""
        slices = np.stack([random.permutation(count) for _ in range(4)], axis=1)
        return self.clip(self.lower + self.width * (slices + random.random((count, 4))) / count)

    def near(self, starts: Array, radius: Array, count: int, random: np.random.Generator) -> Array:
        """Return ``count`` starts around the given ones, ``radius`` in widths: ``[count, 4]``."""
        which = np.arange(count) % len(starts)
        step = random.normal(size=(count, 4)) * radius[which, None]
        return self.clip(starts[which] + step * self.width)

    def clip(self, starts: Array) -> Array:
        """Return the nearest starts in the box; exact, so that no rounding leads out of it."""
        return np.clip(starts, self.lower, self.upper)


def falsify(instance: Instance, spec: Path, seconds: float, seed: int = 0) -> Witness | None:
    """Return a witness that the strict check accepts, or None if none was found.

    seconds: how long to look; with enough of them the search ends after ROUNDS rounds, so
    that the answer is the same everywhere.
    """
    deadline = time.monotonic() + seconds
    replayer = Replayer(instance, spec)
    box, random = Box(*instance.initial_set.bounds()), np.random.default_rng(seed)
    given, rays, plant = instance.disturbance, instance.plant.lidar.rays, instance.make_plant()
    starts = box.corners()
    if given is not None:
        starts = np.tile(starts, (-(-_FIRST // len(starts)), 1))
    tried = disturbed(starts, given, rays, random)
    elite, margins, radius = tried.take(np.empty(0, dtype=np.intp)), np.empty(0), np.empty(0)
    only_one = given is None and not np.any(box.width > 0)
    per_start = 0.0
    for number in range(ROUNDS + 1):
        begin = time.monotonic()
        found = replayer.margins(tried.starts, tried.faults(instance, plant))
        per_start = (time.monotonic() - begin) / len(tried)
        witness = _strict(replayer, tried, found)
        if witness is not None or only_one or number == ROUNDS:
            return witness
        elite, margins, radius = _select(elite, margins, radius, tried, found)
        left = deadline - time.monotonic()
        count = min(LARGEST_BATCH, int(left / 4 / max(per_start, 1e-9)))
        if count < 2:
            return None
        parents = np.arange(count - count // 2) % len(elite)
        local = box.near(elite.starts, radius, len(parents), random)
        fresh = disturbed(box.sample(count // 2, random), given, rays, random)
        others = disturbed(local, given, rays, random)
        near = crossed(elite.take(parents).at(local), others, given, random)
        tried = Candidates.join([fresh, near])
    return None


def _strict(replayer: Replayer, tried: Candidates, margins: Array) -> Witness | None:
    """Return the first of the unsafe candidates, the worst first, that passes alone."""
    for index in np.argsort(margins)[:_STRICT]:
        if not margins[index] <= 0:
            return None
        witness = tried.witness(int(index), replayer.instance)
        if replayer.margin(witness) <= 0:
            return witness
    return None


def _select(
    elite: Candidates, margins: Array, radius: Array, tried: Candidates, found: Array
) -> tuple[Candidates, Array, Array]:
    """Return the best candidates so far, their margins, and how far around each to look next.

    A start that stays among the best is searched more and more closely.
    """
    # Of NaN margins nothing can be said; they go last.
    found = np.nan_to_num(found, nan=np.inf)
    pool, values = Candidates.join([elite, tried]), np.concatenate([margins, found])
    radii = np.concatenate([radius / 2, np.full(len(tried), 0.1)])
    best = np.argsort(values, kind="stable")[:ELITE]
    return pool.take(best), values[best], radii[best]


def _process_age() -> float:
    """Return how long (seconds) this process runs already, the shell before it included."""
    return max(0.0, time.time() - psutil.Process().create_time())


def main(arguments: list[str]) -> int:
    """Answer one instance; return the exit status."""
    try:
        spec, results, timeout = Path(arguments[0]), Path(arguments[1]), float(arguments[2])
    except (IndexError, ValueError):
        print("usage: python -m harness.falsifier SPEC RESULTS TIMEOUT", file=sys.stderr)
        return 2
    try:
        seconds = SHARE * timeout - ENDING_S - _process_age()
        witness = falsify(load_instance(spec), spec, seconds)
    except BadInput as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    answer = f"{Verdict.SAT}\n{format_witness(witness)}" if witness else f"{Verdict.UNKNOWN}\n"
    write_whole(results, answer.encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Experiments: many runs of the closed loop from drawn starts, and what they show.

Runs are done in blocks of a fixed size, and all randomness of a block comes from a seed of
its own. So a run's outcome depends on the experiment and the run's number alone, bit for
bit, whichever order the blocks are done in and by however many workers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, Runs, State, Steer, simulate
from racecar.errors import BadInput
from racecar.faultmodels.draw import SpecFaults, spec_faults
from racecar.faultmodels.spec import FaultSpec
from racecar.faults import FAULTS, DrawnFaults, Faults
from racecar.lidar import Lidar
from racecar.polygon import Array
from racecar.safety import Property
from racecar.track import square_track

#: Runs per block. Changing it changes what every seed means.
BLOCK = 1024

#: The benchmark's horizon: 70 control periods, 7 s.
STEPS = 70

#: Rays of the full scan; it spans 270 degrees, the paper's smaller scans 230 degrees.
FULL_SCAN_RAYS = 1081

Range = tuple[float, float]


class Starts(Protocol):
    """Where the runs of an experiment start."""

    def box(self) -> tuple[Array, Array]:
        """Return the lower and the upper corner, (s, f) in metres, ``[2]`` each."""
        ...

    def states(self, numbers: NDArray[np.intp], runs: int, random: np.random.Generator) -> State:
        """Return the starts of the runs with these numbers (from 0), of ``runs`` in all."""
        ...


@dataclass(frozen=True)
class EvenStarts:
    """Starts spread evenly over a range of s, both ends included.

    The defaults are the benchmark's. s: lowest and highest, metres; f: metres; v: m/s;
    theta: radians. A single run starts in the middle.
    """

    s: Range = (0.65, 0.85)
    f: float = 9.9
    v: float = 0.0
    theta: float = 0.0

    def __post_init__(self) -> None:
        _check_range("s", self.s)

    def box(self) -> tuple[Array, Array]:
        """Return the lower and the upper corner, (s, f) in metres, ``[2]`` each."""
        return np.array([self.s[0], self.f]), np.array([self.s[1], self.f])

    def states(self, numbers: NDArray[np.intp], runs: int, random: np.random.Generator) -> State:
        """Return the starts of the runs with these numbers; nothing is drawn."""
        del random
        share = numbers / (runs - 1) if runs > 1 else np.full(len(numbers), 0.5)
        # Weighing both ends makes each of them, and a range of one value, exact.
        s = np.clip((1 - share) * self.s[0] + share * self.s[1], *self.s)
        return State.start(s, self.f, self.v, self.theta)


@dataclass(frozen=True)
class RandomStarts:
    """Starts drawn uniformly over ranges of s and theta.

    The defaults are the paper's runs with faults. s: metres; f: metres; v: m/s;
    theta: radians.
    """

    s: Range = (0.55, 0.95)
    f: float = 10.0
    v: float = 0.0
    theta: Range = (-0.3, 0.3)

    def __post_init__(self) -> None:
        _check_range("s", self.s)
        _check_range("theta", self.theta)

    def box(self) -> tuple[Array, Array]:
        """Return the lower and the upper corner, (s, f) in metres, ``[2]`` each."""
        return np.array([self.s[0], self.f]), np.array([self.s[1], self.f])

    def states(self, numbers: NDArray[np.intp], runs: int, random: np.random.Generator) -> State:
        """Draw the starts of the runs with these numbers."""
        del runs
        s = random.uniform(*self.s, len(numbers))
        return State.start(s, self.f, self.v, random.uniform(*self.theta, len(numbers)))


def _check_range(name: str, limits: Range) -> None:
    low, high = limits
    if not (math.isfinite(low) and math.isfinite(high)):
        raise BadInput(f"start: {name} from {low} to {high}; both ends must be finite")
    if low > high:
        raise BadInput(f"start: {name} from {low} to {high}; the lower end is above the upper")


@dataclass(frozen=True)
class Experiment:
    """What is run: the system, the property, the starts, the faults and the seed.

    runs: how many; steps: control periods of each; seed: 0 or more. Raises BadInput for
    starts that reach into a wall and for numbers out of range.
    """

    plant: Plant
    safety: Property
    starts: Starts
    faults: Faults | FaultSpec = FAULTS["none"]
    runs: int = 1001
    steps: int = STEPS
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("runs", 1), ("steps", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise BadInput(f"experiment: {name} is {getattr(self, name)}; give {least} or more")
        lower, upper = self.starts.box()
        check_free(self.plant, lower, upper)

    @property
    def blocks(self) -> int:
        """The number of blocks."""
        return -(-self.runs // BLOCK)


def check_free(plant: Plant, lower: Array, upper: Array, what: str = "start") -> None:
    """Raise BadInput if a box of positions (s, f) in the first hall's frame touches a wall.

    lower, upper: ``[2]``, metres; what: named in the message.
    """
    walls = plant.track.frames[0].obstacles
    if any(wall.relevant(lower, upper, 0.0) is not None for wall in walls):
        places = ", ".join(
            f"{name} = {low:g} m" if low == high else f"{name} from {low:g} to {high:g} m"
            for name, low, high in zip("sf", lower, upper, strict=True)
        )
        raise BadInput(
            f"{what}: {places} is inside a wall or touches one; "
            f"in the first hall s lies between 0 and {plant.track.width:g} m"
        )


@dataclass(frozen=True)
class Outcome:
    """Where the runs started and how they went; run i is row i of both."""

    start: State
    runs: Runs
    steps: int

    @property
    def safe(self) -> NDArray[np.bool_]:
        """Which runs are safe as the paper judges, ``[runs]``.

        It looks at control instants only and does not count a crash at the last one.
        """
        return (self.runs.crash_step < 0) | (self.runs.crash_step >= self.steps)

    @property
    def safe_continuous(self) -> NDArray[np.bool_]:
        """Which runs are safe at all times, the end included: ``[runs]``."""
        return self.runs.margin > 0

    @property
    def steps_driven(self) -> int:
        """The number of control periods driven by all runs together."""
        crash = self.runs.crash_step
        return int(np.where(crash < 0, self.steps, crash).sum())


def block_random(seed: int, block: int) -> np.random.Generator:
    """Return the source of all randomness of one block."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(block,)))


def draw_faults(
    faults: Faults | FaultSpec,
    plant: Plant,
    numbers: NDArray[np.intp],
    seed: int,
    random: np.random.Generator,
) -> DrawnFaults | SpecFaults | None:
    """Return the faults of the runs with these numbers; None if there are none.

    Those of a FaultSpec depend on seed and numbers, those of Faults are drawn from ``random``.
    """
    if isinstance(faults, FaultSpec):
        return spec_faults(faults, plant, numbers, seed)
    if not (faults.missing or faults.noise):
        return None
    lidar = plant.lidar
    return faults.draw(lidar.rays, len(numbers), plant.track.width, lidar.range, random)


def run_block(experiment: Experiment, steer: Steer, record: bool, block: int) -> Outcome:
    """Do one block of runs; its outcome depends on nothing but the arguments."""
    numbers = np.arange(block * BLOCK, min((block + 1) * BLOCK, experiment.runs))
    random = block_random(experiment.seed, block)
    start = experiment.starts.states(numbers, experiment.runs, random)
    disturb = draw_faults(experiment.faults, experiment.plant, numbers, experiment.seed, random)
    runs = simulate(
        experiment.plant, steer, experiment.safety, start, experiment.steps, disturb, record
    )
    return Outcome(start, runs, experiment.steps)


#: Applies a function to every block and gives the outcomes in the order of the blocks, as
#: ``map`` and the ``map`` of the executors in concurrent.futures do.
MapBlocks = Callable[[Callable[[int], Outcome], Iterable[int]], Iterable[Outcome]]


def run_experiment(
    experiment: Experiment,
    steer: Steer,
    record: bool = False,
    progress: Callable[[int], None] | None = None,
    map_blocks: MapBlocks = map,
) -> Outcome:
    """Do all runs of an experiment.

    Args:
        experiment: What to run.
        steer: The controller, scans ``[rays, batch]`` (m) to steering ``[batch]`` (rad).
        record: Whether to keep the traces (see racecar.closed_loop.Runs).
        progress: Called after each block with the number of runs in it.
        map_blocks: Who does the blocks; the result does not depend on it.
    """

    def watched() -> Iterator[Outcome]:
        for outcome in map_blocks(
            partial(run_block, experiment, steer, record), range(experiment.blocks)
        ):
            if progress is not None:
                progress(len(outcome.start))
            yield outcome

    return _join(list(watched()))


def _join(parts: list[Outcome]) -> Outcome:
    start = State(
        *(
            np.concatenate([getattr(part.start, name) for part in parts])
            for name in ("frame", "s", "f", "v", "theta")
        )
    )
    traces = [part.runs.trace for part in parts if part.runs.trace is not None]
    runs = Runs(
        np.concatenate([part.runs.margin for part in parts]),
        np.concatenate([part.runs.margin_sampled for part in parts]),
        np.concatenate([part.runs.crash_step for part in parts]),
        {name: np.concatenate([t[name] for t in traces]) for name in traces[0]} if traces else None,
    )
    return Outcome(start, runs, parts[0].steps)


def default_field_of_view(rays: int) -> float:
    """Return the field of view (rad) of the paper's scans: 230 degrees, the full scan 270."""
    return math.radians(270 if rays == FULL_SCAN_RAYS else 230)


def paper_plant(rays: int) -> Plant:
    """Return the paper's track and car with a LiDAR of so many rays and their field of view."""
    return Plant(square_track(), Bicycle(), Lidar(rays, default_field_of_view(rays)))

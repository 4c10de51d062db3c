"""Start sets of the unrolled closed loop: near the turn, and the benchmark's own start."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from generator.openloop.numbers import nearest
from generator.openloop.spec import Box
from generator.openloop.views import MIDDLE, UNIT
from generator.unrolled.geometry import StartBox
from generator.unrolled.graph import Task
from generator.unrolled.patterns import Pattern, connected, find_patterns
from racecar.closed_loop import Plant, State, simulate
from racecar.controller import Controller
from racecar.polygon import Array
from racecar.safety import Property

#: Steps of the short runs, which begin near the turn, and half the width of their boxes in s, f
#: (m) and theta (rad), in multiples of UNIT.
SHORT = {1: 64, 2: 32, 5: 16, 10: 8, 20: 4}
#: The benchmark's horizon, from its own start.
LONG = 70
#: Short runs begin where the front wall is at most this far away (m) on the nominal drive.
FRONT = 2.0
#: The benchmark's start: bounds of s, and f (m).
_RANGE, _START_FRONT = (Fraction("0.65"), Fraction("0.85")), Fraction("9.9")
#: Lines of starts are as long (mm) as makes for at most so many wall patterns.
LINES, MOST_PATTERNS = (100, 50, 20, 10, 5, 2, 1), 2
#: A box is turned left in such steps (degrees) until a run from it is unsafe by this much (m).
_TURNS, _CLEARLY = range(5, 95, 5), 0.02


@dataclass(frozen=True, eq=False)
class StartSet:
    """A set of start states (s, f, v, theta); label: in IDs; words: what it is."""

    label: str
    words: str
    box: Box

    @property
    def bounds(self) -> StartBox:
        """The set in float64."""
        return StartBox(self.box.lower.astype(float), self.box.upper.astype(float))


@dataclass(frozen=True, eq=False)
class Drive:
    """The nominal drive of a controller from s = ``start`` (m)."""

    controller: Controller
    plant: Plant
    safety: Property
    start: Fraction = MIDDLE

    def task(self, starts: StartSet, steps: int) -> Task:
        """Return what is unrolled from a set of starts."""
        return Task(self.controller, self.plant, self.safety, starts.bounds, steps)

    @cached_property
    def near_turn(self) -> list[int] | None:
        """s, f, v and theta near the turn, in multiples of UNIT; None if it is not come to."""
        start, steer = State.start(float(self.start)), self.controller.steering_rows
        runs = simulate(self.plant, steer, self.safety, start, LONG, record=True)
        assert runs.trace is not None
        driving = np.isfinite(runs.trace["steering"][0]) & (runs.trace["frame"][0, :-1] == 0)
        there = np.flatnonzero(driving & (runs.trace["f"][0, :-1] <= FRONT))
        if not there.size:
            return None
        values = [runs.trace[name][0, there[0]] for name in ("s", "f", "v", "theta")]
        return [round(float(value) / float(UNIT)) for value in values]


def start_sets(drive: Drive, steps: int) -> Iterator[StartSet]:
    """Yield the sets that are asked about as they are, for so many steps."""
    if steps == LONG:
        yield _line("range", *_RANGE, "the benchmark's whole start range")
        return
    centre = drive.near_turn
    if centre is None:
        return
    half = SHORT[steps]
    yield _box("box", "around the state on the nominal drive", centre, half)
    for degrees in _TURNS:
        turned = [*centre[:3], centre[3] + round(math.radians(degrees) / float(UNIT))]
        words = f"the same turned left by about {degrees} degrees"
        chosen = _box(f"left{degrees}deg", words, turned, half)
        first, least = _sampled_margins(drive.task(chosen, steps))
        if first <= 0:
            return
        if least <= -_CLEARLY:
            yield chosen
            return


def pattern_set(drive: Drive, steps: int) -> tuple[StartSet, list[Pattern]] | None:
    """Return the longest line of starts in s with few wall patterns, and these.

    None if there is none from which all runs are safe.
    """
    for length in LINES:
        line = _line_of(drive, steps, length)
        if line is None or (length == LINES[0] and not _middle_is_safe(drive.task(line, steps))):
            return None
        patterns, least = find_patterns(drive.task(line, steps), MOST_PATTERNS)
        if least > 0 and len(patterns) <= MOST_PATTERNS and connected(patterns):
            return line, patterns
    return None


def _line_of(drive: Drive, steps: int, length: int) -> StartSet | None:
    """Return the starts on a line of so many mm in s, for so many steps."""
    label, words, half = f"line{length}mm", f"{length} mm in s", Fraction(length, 2000)
    if steps == LONG:
        middle = drive.start
        return _line(label, middle - half, middle + half, f"{words}, the benchmark's start")
    if drive.near_turn is None:
        return None
    s, *rest = (value * UNIT for value in drive.near_turn)
    box = Box.inside([s - half, *rest], [s + half, *rest])
    return StartSet(label, f"{words} around the state on the nominal drive", box)


def _middle_is_safe(task: Task) -> bool:
    """Return whether the run from the middle, which all lines share, is safe."""
    middle = (task.start.lower + task.start.upper) / 2
    return _least_margin(task, middle[None]) > 0


def _line(label: str, low: Fraction, high: Fraction, words: str) -> StartSet:
    """Return starts of the benchmark: s between bounds, f as near to 9.9 m as float32 comes."""
    front = Fraction(float(nearest(_START_FRONT)))
    rest = [front, Fraction(0), Fraction(0)]
    return StartSet(label, words, Box.inside([low, *rest], [high, *rest]))


def _box(label: str, words: str, centre: list[int], half: int) -> StartSet:
    halves = (half, half, 0, half)
    lower = [(x - h) * UNIT for x, h in zip(centre, halves, strict=True)]
    upper = [(x + h) * UNIT for x, h in zip(centre, halves, strict=True)]
    return StartSet(label, words, Box.inside(lower, upper))


def _sampled_margins(task: Task) -> tuple[float, float]:
    """Return the least margin (m) of sampled starts, and of the runs from them."""
    random = np.random.default_rng(0)
    share = np.vstack([np.zeros(4), np.ones(4), random.uniform(size=(126, 4))])
    starts = task.start.lower + share * (task.start.upper - task.start.lower)
    first = task.plant.margin(task.safety, State.start(*starts.T))
    return float(first.min()), _least_margin(task, starts)


def _least_margin(task: Task, starts: Array) -> float:
    """Return the least margin (m) at control instants of the runs from some starts."""
    steer, state = task.controller.steering_rows, State.start(*starts.T)
    runs = simulate(task.plant, steer, task.safety, state, task.steps)
    return float(runs.margin_sampled.min())

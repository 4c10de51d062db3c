"""The reference executor: runs an automaton numerically from one start point.

Time passes in a mode until its clock invariant ends; then the one open jump is taken. Where
several are open (missing rays) or a reset leaves a range (noise), the caller chooses. Flows are
integrated by extrapolation of the modified midpoint rule (Gragg, Bulirsch and Stoer; Hairer,
Norsett, Wanner, Solving Ordinary Differential Equations I, section II.9), to about 1e-14.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from generator.hybrid.automaton import CLOCK, Assignment, Automaton, Constraint, Jump, Mode
from generator.hybrid.expression import compiled

Vector = NDArray[np.float64]

#: Midpoint steps of the rows of the extrapolation table.
_STEPS = (2, 4, 6, 8, 10, 12, 14, 16, 18, 20)
_TOLERANCE = 4e-15


@dataclass(frozen=True)
class Visit:
    """A mode that a run came to, and the values with which it entered."""

    mode: str
    values: dict[str, float]


#: Chooses one of several open jumps, given the values.
Choose = Callable[[Sequence[Jump], Mapping[str, float]], Jump]
#: Chooses what is added in a reset with a range.
Spread = Callable[[Assignment], float]


def only_one(jumps: Sequence[Jump], values: Mapping[str, float]) -> Jump:
    """Return the only open jump; ValueError if there are more."""
    del values
    if len(jumps) != 1:
        raise ValueError(f"{len(jumps)} jumps are open in {jumps[0].source}")
    return jumps[0]


def middle(assignment: Assignment) -> float:
    """Return the middle of a range."""
    return (assignment.spread[0] + assignment.spread[1]) / 2


class Executor:
    """An automaton made ready to run."""

    def __init__(self, automaton: Automaton) -> None:
        self.automaton = automaton
        self._modes = {mode.name: _ReadyMode(mode) for mode in automaton.modes}
        self._jumps = {
            name: [_ReadyJump(jump) for jump in jumps]
            for name, jumps in automaton.jumps_from().items()
        }

    def start(self, **given: float) -> dict[str, float]:
        """Return the middle of the initial box with some values replaced."""
        middles = {name: (low + high) / 2 for name, (low, high) in self.automaton.initial.items()}
        return middles | given

    def run(
        self,
        values: Mapping[str, float],
        mode: str | None = None,
        choose: Choose = only_one,
        spread: Spread = middle,
    ) -> Iterator[Visit]:
        """Yield the modes of a run, until one from which no jump leads.

        values: of all variables; mode: where to start, the initial mode by default. Raises
        ValueError if no jump is open when a mode must be left.
        """
        name = mode or self.automaton.initial_mode
        now = dict(values)
        yield Visit(name, dict(now))
        while self._jumps[name]:
            dwell = self._modes[name].dwell
            self._modes[name].flow(now, dwell - now[CLOCK])
            now[CLOCK] = dwell
            jumps = [jump for jump in self._jumps[name] if jump.open(now)]
            if not jumps:
                raise ValueError(f"no jump is open in {name}")
            taken = choose([jump.jump for jump in jumps], now)
            ready = next(jump for jump in jumps if jump.jump is taken)
            ready.reset(now, spread)
            name = taken.target
            yield Visit(name, dict(now))

    def after(self, visit: Visit, time: float) -> dict[str, float]:
        """Return the values when a mode has lasted ``time`` seconds."""
        now = dict(visit.values)
        self._modes[visit.mode].flow(now, time)
        return now


class _ReadyMode:
    def __init__(self, mode: Mode) -> None:
        self.dwell = mode.dwell
        self._names = list(mode.flow)
        self._rates = [compiled(rate) for rate in mode.flow.values()]

    def flow(self, values: dict[str, float], time: float) -> None:
        """Let time pass."""
        if time == 0.0:
            return
        inner = dict(values)

        def rate(state: Vector) -> Vector:
            inner.update(zip(self._names, state.tolist(), strict=True))
            return np.array([one(inner) for one in self._rates])

        start = np.array([values[name] for name in self._names])
        end = _integrate(rate, start, time)
        values.update(zip(self._names, end.tolist(), strict=True))


class _ReadyJump:
    def __init__(self, jump: Jump) -> None:
        self.jump = jump
        self._guard = [(compiled(c.expression), c) for c in jump.guard]
        self._reset = [(compiled(a.expression), a) for a in jump.reset]

    def open(self, values: Mapping[str, float]) -> bool:
        """Tell whether the guard holds."""
        return all(holds(constraint, one(values)) for one, constraint in self._guard)

    def reset(self, values: dict[str, float], spread: Spread) -> None:
        """Reset all variables at once."""
        values.update({a.variable: one(values) + _added(a, spread) for one, a in self._reset})


def _added(assignment: Assignment, spread: Spread) -> float:
    return spread(assignment) if assignment.spread != (0.0, 0.0) else 0.0


def holds(constraint: Constraint, value: float) -> bool:
    """Tell whether a constraint holds where its expression has a value."""
    match constraint.relation:
        case "<=":
            return value <= constraint.bound
        case "<":
            return value < constraint.bound
        case ">=":
            return value >= constraint.bound
        case ">":
            return value > constraint.bound
    return value == constraint.bound


def _integrate(rate: Callable[[Vector], Vector], start: Vector, time: float) -> Vector:
    """Return the state after ``time``; intervals are halved until the extrapolation converges."""
    state, done, step = start, 0.0, time
    while done < time:
        step = min(step, time - done)
        try:
            end = _extrapolated(rate, state, step)
        except OverflowError:  # the step is far too long
            end = None
        if end is None:
            step /= 2
            if step < 1e-9 * time:
                raise ValueError("a flow has no solution for so long")
            continue
        state, done, step = end, done + step, 2 * step
    return state


def _extrapolated(rate: Callable[[Vector], Vector], start: Vector, time: float) -> Vector | None:
    """Return the extrapolated state after one interval, or None if it did not converge."""
    first = rate(start)
    row: list[Vector] = []
    for count in _STEPS:
        new = [_midpoint(rate, start, first, time, count)]
        for j, old in enumerate(row, start=1):
            ratio = (count / _STEPS[len(row) - j]) ** 2
            new.append(new[-1] + (new[-1] - old) / (ratio - 1))
        if row:
            scale = np.maximum(np.abs(new[-1]), 1.0)
            if np.max(np.abs(new[-1] - new[-2]) / scale, initial=0.0) < _TOLERANCE:
                return new[-1]
        row = new
    return None


def _midpoint(
    rate: Callable[[Vector], Vector], start: Vector, first: Vector, time: float, count: int
) -> Vector:
    """Return the state after ``count`` steps of the midpoint rule."""
    step = time / count
    before, now = start, start + step * first
    for _ in range(count - 1):
        before, now = now, before + 2 * step * rate(now)
    return now

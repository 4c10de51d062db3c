"""The closed loop: measure, evaluate the controller, hold the steering for 0.1 s.

All runs of a batch go on side by side. A run ends at its horizon, or at the first control
instant at which its margin is not positive; its margin is the least up to then (NaN if the
controller answered with NaN: never safe).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.bicycle import Arc, Bicycle
from racecar.errors import BadInput
from racecar.lidar import Lidar
from racecar.polygon import Array
from racecar.safety import Property, arc_margin, margin
from racecar.track import Track

#: Steering for scans ``[rays, batch]`` in metres: ``[batch]`` in radians. One that treats every
#: column by itself may have an attribute ``cars_at_once``: undisturbed scans then reach it in
#: blocks of so many columns, while they are in the processor's cache; it must not keep them.
Steer = Callable[[Array], Array]
#: What faults and noise make of a scan: (step, state, scan ``[rays, batch]``) -> scan.
Disturb = Callable[[int, "State", Array], Array]


@dataclass(frozen=True)
class State:
    """Cars in local frames; all fields ``[batch]``.

    frame: index of the hall; s, f: metres; v: m/s; theta: radians.
    """

    frame: NDArray[np.intp]
    s: Array
    f: Array
    v: Array
    theta: Array

    @classmethod
    def start(
        cls, s: ArrayLike, f: ArrayLike = 9.9, v: ArrayLike = 0.0, theta: ArrayLike = 0.0
    ) -> State:
        """Return cars in the first hall; the defaults are the benchmark's start."""
        arrays = np.broadcast_arrays(
            *(np.atleast_1d(np.asarray(x, float)) for x in (s, f, v, theta))
        )
        s, f, v, theta = (np.array(x) for x in arrays)
        return cls(np.zeros(s.shape, dtype=np.intp), s, f, v, theta)

    def __len__(self) -> int:
        return len(self.s)

    def take(self, index: NDArray | slice) -> State:
        """Return the cars at ``index``."""
        return State(
            self.frame[index], self.s[index], self.f[index], self.v[index], self.theta[index]
        )


@dataclass(frozen=True)
class Plant:
    """Everything but the controller: track, car, LiDAR and the control period (s)."""

    track: Track
    bicycle: Bicycle
    lidar: Lidar
    period: float = 0.1

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period) and self.period > 0):
            raise BadInput(f"plant: the control period is {self.period} s; it must be positive")

    def scan_rows(self, state: State) -> Array:
        """Return the scans of all cars, ``[rays, batch]``, metres."""
        groups = _groups(self._alike, state)
        if len(groups) == 1:
            obstacles = self.track.frames[groups[0][0]].obstacles
            return self.lidar.scan_rows(obstacles, state.s, state.f, state.theta)
        scan = np.empty((len(state), self.lidar.rays))
        for index, cars in groups:
            part, obstacles = state.take(cars), self.track.frames[index].obstacles
            scan[cars] = self.lidar.scan(obstacles, part.s, part.f, part.theta)
        return scan.T

    def scan_blocks(self, state: State, block: Array) -> Iterator[tuple[NDArray | slice, Array]]:
        """Yield the same scans in blocks: (which cars, ``[rays, cars]``).

        block: ``[cars at a time, rays]``, memory for all blocks; each is good until the next.
        """
        for index, cars in _groups(self._alike, state):
            part, obstacles = state.take(cars), self.track.frames[index].obstacles
            for some, scan in self.lidar.scan_blocks(obstacles, part.s, part.f, part.theta, block):
                yield (some if isinstance(cars, slice) else cars[some]), scan.T

    def drive(self, state: State, steering: Array) -> tuple[State, Arc]:
        """Hold the steering (``[batch]``, rad) for a period: the state after it and the arc.

        The arc, and the returned state, are in the frame that the step began in.
        """
        arc, theta = self.bicycle.arc(state.s, state.f, state.v, state.theta, steering, self.period)
        v = self.bicycle.speed_after(state.v, self.period)
        return State(state.frame, *arc.end, v, theta), arc

    def advance(self, state: State) -> State:
        """Move the cars that are far enough into the next hall to its frame."""
        frame, s, f, theta = state.frame, state.s, state.f, state.theta
        for index, cars in _groups(self._alike, state):
            change = self.track.frames[index].advance
            if change is None:
                continue
            a_s, a_f, b = change.guard
            now = np.zeros(len(state), dtype=bool)
            now[cars] = a_s * state.s[cars] + a_f * state.f[cars] > b
            if not now.any():
                continue
            (m00, m01), (m10, m11) = change.matrix
            count = len(self.track.halls)
            frame = np.where(now, (state.frame + 1) % count, frame)
            s = np.where(now, m00 * state.s + m01 * state.f + change.offset[0], s)
            f = np.where(now, m10 * state.s + m11 * state.f + change.offset[1], f)
            theta = np.where(now, state.theta + change.rotation, theta)
        return replace(state, frame=frame, s=s, f=f, theta=theta)

    def margin(self, safety: Property, state: State) -> Array:
        """Return the margin (m) of each state."""
        groups = _groups(safety.alike, state)
        if len(groups) == 1:
            return margin(safety.unsafe[groups[0][0]], state.s, state.f)
        least = np.empty(len(state))
        for index, cars in groups:
            least[cars] = margin(safety.unsafe[index], state.s[cars], state.f[cars])
        return least

    def arc_margin(self, safety: Property, state: State, arc: Arc, below: Array) -> Array:
        """Return the lesser of ``below`` and the least margin (m) along each arc."""
        groups = _groups(safety.alike, state)
        if len(groups) == 1:
            return arc_margin(safety.unsafe[groups[0][0]], arc, below)
        least = np.empty(len(state))
        for index, cars in groups:
            least[cars] = arc_margin(safety.unsafe[index], arc.take(cars), below[cars])
        return least

    @cached_property
    def _alike(self) -> NDArray[np.intp]:
        return self.track.alike


def _groups(alike: NDArray[np.intp], state: State) -> list[tuple[int, NDArray | slice]]:
    """Group cars by frames that are alike: (index of one such frame, which cars)."""
    if alike.max() == 0:
        return [(0, slice(None))]
    first = alike[state.frame]
    kinds = np.unique(first)
    if len(kinds) == 1:
        return [(int(kinds[0]), slice(None))]
    return [(int(kind), np.flatnonzero(first == kind)) for kind in kinds]


@dataclass(frozen=True)
class Runs:
    """The outcome of a batch of runs; margins in metres.

    margin: ``[batch]``, continuous time; margin_sampled: ``[batch]``, least over the control
    instants; crash_step: ``[batch]``, the control instant of the crash that ended the run,
    or -1; frame, s, f, v, theta: ``[batch, steps + 1]`` and steering ``[batch, steps]``, when
    recorded (a run that has ended keeps its last state, and steering NaN).
    """

    margin: Array
    margin_sampled: Array
    crash_step: NDArray[np.intp]
    trace: dict[str, NDArray] | None = None


def simulate(
    plant: Plant,
    steer: Steer,
    safety: Property,
    start: State,
    steps: int,
    disturb: Disturb | None = None,
    record: bool = False,
) -> Runs:
    """Run the closed loop for ``steps`` control periods from every start at once."""
    state = start
    sampled = plant.margin(safety, start)
    least = sampled.copy()
    crash = np.where(sampled > 0, -1, 0)  # NaN counts as a crash
    trace = _empty_trace(len(start), steps) if record else None
    at_once = min(len(start), getattr(steer, "cars_at_once", 0))
    block = np.empty((at_once, plant.lidar.rays))
    for step in range(steps):
        going = crash < 0
        if trace is not None:
            _write(trace, state, step)
        if not going.any():
            if trace is not None:
                _write(trace, state, slice(step, None))
            return Runs(least, sampled, crash, trace)
        if len(block) and disturb is None:
            steering = np.empty(len(state))
            for cars, scan in plant.scan_blocks(state, block):
                steering[cars] = steer(scan)
        else:
            scan = plant.scan_rows(state)
            steering = steer(scan if disturb is None else disturb(step, state, scan))
        after, arc = plant.drive(state, steering)
        along = plant.arc_margin(safety, state, arc, least)
        at_end = plant.margin(safety, after)
        least = np.where(going, along, least)
        sampled = np.where(going, np.minimum(sampled, at_end), sampled)
        crash = np.where(going & ~(at_end > 0), step + 1, crash)
        state = _choose(going, plant.advance(after), state)
        if trace is not None:
            trace["steering"][:, step] = np.where(going, steering, np.nan)
    if trace is not None:
        _write(trace, state, steps)
    return Runs(least, sampled, crash, trace)


_FIELDS = tuple(field.name for field in fields(State))


def _choose(where: NDArray[np.bool_], a: State, b: State) -> State:
    if where.all():
        return a
    return State(*(np.where(where, getattr(a, name), getattr(b, name)) for name in _FIELDS))


def _empty_trace(batch: int, steps: int) -> dict[str, NDArray]:
    trace: dict[str, NDArray] = {name: np.empty((batch, steps + 1)) for name in _FIELDS}
    trace["frame"] = np.empty((batch, steps + 1), dtype=np.intp)
    trace["steering"] = np.full((batch, steps), np.nan)
    return trace


def _write(trace: dict[str, NDArray], state: State, step: int | slice) -> None:
    for name in _FIELDS:
        trace[name].T[step] = getattr(state, name)

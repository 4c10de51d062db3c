"""Runs of the closed loop for pictures: sampled starts, and witnesses as they are replayed.

Instances that share a controller, a plant and a property are driven side by side.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.given import Malformed, check_shape, complaint, given_steps, make_faults
from racecar.closed_loop import Disturb, Plant, State, Steer, simulate
from racecar.disturbance import Disturbance
from racecar.faults import GivenFaults
from racecar.instance import InitialSet, Instance
from racecar.mirrors import mirroring
from racecar.polygon import Array
from racecar.safety import Property
from racecar.witness import Witness

#: A start set at most so wide (m) gets few traces.
NARROW = 0.0051
FEW, MANY = 3, 9
#: Sampled runs of an instance with a disturbance; the first is undisturbed.
DISTURBED = 7
_COORDINATES = ("s", "f", "v", "theta")


@dataclass(frozen=True, eq=False)
class Trace:
    """One run, at the control instants 0 to k.

    start: s, f, v, theta (m, m, m/s, rad); x, y, heading: global, ``[k + 1]`` (m, m, rad);
    margin: ``[k + 1]``, at the instants (m); least: ``[k]``, the least along each period (m);
    steering: ``[k]`` (rad); missing: for each of the k steps the rays that are missing or that a
    mirror takes; crashed: whether it ends because the car is in the unsafe set at its last instant;
    mirror: index of the stretch of wall that mirrors, if one does.
    """

    start: tuple[float, float, float, float]
    x: Array
    y: Array
    heading: Array
    margin: Array
    least: Array
    steering: Array
    missing: Sequence[Sequence[int]]
    crashed: bool
    mirror: int | None = None


def sample_starts(box: InitialSet) -> Array:
    """Return starts ``[k, 4]`` spread over a box: evenly on a line, else centre and corners."""
    lower, upper = box.bounds()
    free = np.flatnonzero(upper > lower)
    if not len(free):
        return lower[None, :]
    if len(free) == 1:
        count = FEW if box.s[1] - box.s[0] <= NARROW and free[0] == 0 else MANY
        starts = np.tile(lower, (count, 1))
        starts[:, free[0]] = np.linspace(lower[free[0]], upper[free[0]], count)
        return starts
    corners = [np.where(upper > lower, (lower + upper) / 2, lower)]
    for sides in itertools.product((0, 1), repeat=len(free)):
        corner = lower.copy()
        corner[free] = np.where(sides, upper[free], lower[free])
        corners.append(corner)
    return np.array(corners)


def drive(
    plant: Plant,
    steer: Steer,
    safety: Property,
    starts: Array,
    steps: int,
    disturb: Disturb | None = None,
) -> list[Trace]:
    """Drive cars from starts ``[k, 4]``, as racecar.closed_loop.simulate does.

    disturb: of all cars alike.
    """
    runs = simulate(plant, steer, safety, State.start(*starts.T), steps, disturb, record=True)
    trace = runs.trace
    assert trace is not None
    last = np.where(runs.crash_step < 0, steps, runs.crash_step)
    margins = np.empty(trace["s"].shape)
    least = np.full(trace["steering"].shape, np.nan)
    far = np.full(len(starts), np.inf)
    missing: list[dict[int, list[int]]] = []
    for step in range(steps + 1):
        state = State(*(trace[name][:, step] for name in ("frame", *_COORDINATES)))
        margins[:, step] = plant.margin(safety, state)
        if step < steps:
            steering = np.nan_to_num(trace["steering"][:, step])
            least[:, step] = plant.arc_margin(safety, state, plant.drive(state, steering)[1], far)
            if isinstance(disturb, GivenFaults):
                missing.append(_missing(disturb, step, state, plant))
    x, y, heading = plant.track.to_global(*(trace[name] for name in ("frame", "s", "f", "theta")))
    traces = []
    for car, end in enumerate(last):
        gone = [rays.get(car, []) for rays in missing[:end]]
        start = tuple(float(value) for value in starts[car])
        assert len(start) == 4
        traces.append(
            Trace(
                start,
                x[car, : end + 1],
                y[car, : end + 1],
                heading[car, : end + 1],
                margins[car, : end + 1],
                least[car, :end],
                trace["steering"][car, :end],
                gone,
                bool(runs.crash_step[car] >= 0),
                _mirror(disturb, car),
            )
        )
    return traces


def _missing(faults: GivenFaults, step: int, state: State, plant: Plant) -> dict[int, list[int]]:
    """Return which rays are missing in a step, of the cars that miss some."""
    if faults.gone is None and faults.mirrors is None:
        return {}
    found: dict[int, list[int]] = {}
    for car, ray in np.argwhere(faults.missing(step, state, plant.scan_rows(state)).T):
        found.setdefault(int(car), []).append(int(ray))
    return found


def _mirror(faults: Disturb | None, car: int) -> int | None:
    """Return which stretch mirrors for a car."""
    if not isinstance(faults, GivenFaults) or faults.mirrors is None:
        return None
    chosen = int(faults.mirrors.chosen[car])
    return chosen if chosen >= 0 else None


def sample_faults(
    disturbance: Disturbance, plant: Plant, steps: int, names: Sequence[str]
) -> GivenFaults:
    """Return disturbances of DISTURBED cars for each instance named, side by side.

    Of each instance's cars the first is undisturbed; the others' are drawn from what is allowed,
    for the same name always the same.
    """
    rays, cars = plant.lidar.rays, DISTURBED * len(names)
    each_step = disturbance.choice == "step"
    gone = np.zeros((steps, rays, cars) if each_step else (rays, cars), dtype=bool)
    noise = np.zeros((steps, rays, cars)) if disturbance.noise else None
    mirror = np.full(cars, -1)
    for place, name in enumerate(names):
        seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8])
        random = np.random.default_rng(seed)
        for car in range(DISTURBED * place + 1, DISTURBED * (place + 1)):
            for column in gone[..., car] if each_step else gone[None, :, car]:
                column[random.choice(rays, disturbance.missing, replace=False)] = True
            if noise is not None:
                noise[..., car] = random.uniform(
                    -disturbance.noise, disturbance.noise, (steps, rays)
                )
            if disturbance.mirrors is not None:
                mirror[car] = random.integers(len(disturbance.mirrors.segments))
    return GivenFaults(
        plant.track.width,
        plant.lidar.range,
        gone if disturbance.missing else None,
        disturbance.turn_only,
        noise,
        mirroring(disturbance.mirrors, plant, mirror),
    )


def given_faults(instance: Instance, witnesses: Sequence[Witness]) -> GivenFaults | None:
    """Return the disturbances of witnesses, side by side; None if the instance has none.

    Where a witness's lists end, nothing is disturbed: see cut().
    """
    if instance.disturbance is None:
        return None
    shape = (instance.steps, instance.plant.lidar.rays, len(witnesses))
    gone, noise = np.zeros(shape, dtype=bool), np.zeros(shape)
    mirror = [-1 if w.mirror is None else w.mirror for w in witnesses]
    for car, witness in enumerate(witnesses):
        faults = make_faults(instance, witness)
        assert faults is not None
        if faults.gone is not None and faults.gone.ndim == 2:
            gone[:, :, car] = faults.gone[:, 0]
        elif faults.gone is not None:
            gone[: len(faults.gone), :, car] = faults.gone[..., 0]
        if faults.noise is not None:
            noise[: len(faults.noise), :, car] = faults.noise[..., 0]
    plant, given = instance.make_plant(), instance.disturbance
    return GivenFaults(
        plant.track.width,
        plant.lidar.range,
        gone,
        given.turn_only,
        noise,
        mirroring(given.mirrors, plant, mirror),
    )


def fits(instance: Instance, witness: Witness) -> bool:
    """Whether a witness has the form that an instance asks for, and its choices are allowed."""
    try:
        check_shape(instance, witness)
    except Malformed:
        return False
    return complaint(instance, witness) is None and given_steps(instance, witness) > 0


def cut(trace: Trace, steps: int) -> Trace:
    """Return the part of a run in its first so many periods."""
    if len(trace.steering) <= steps:
        return trace
    return Trace(
        trace.start,
        trace.x[: steps + 1],
        trace.y[: steps + 1],
        trace.heading[: steps + 1],
        trace.margin[: steps + 1],
        trace.least[:steps],
        trace.steering[:steps],
        trace.missing[:steps],
        False,
        trace.mirror,
    )


def witness_starts(witnesses: Sequence[Witness]) -> Array:
    """Return the start states of witnesses, ``[k, 4]``."""
    return np.array([[getattr(w, name) for name in _COORDINATES] for w in witnesses])

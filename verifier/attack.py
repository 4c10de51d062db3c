"""Attacks on a disturbed car: a start, what is lost, and a push for every step.

A car feels a disturbed scan only through one number, the steering. So noise need not be
searched ray by ray: a push of u in [-1, 1] adds ``u * noise * sign(gradient of the steering)``
to the scan, which moves the steering most to the left (u = 1) or right (u = -1). Where rays may
be missing anew at every step, a push beyond half of its range picks those that move the steering
most in its direction. Which wall mirrors is chosen once, like the start.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.closed_loop import State
from racecar.controller import Controller, Layer
from racecar.disturbance import Disturbance
from racecar.faults import GivenFaults, in_turn
from racecar.mirrors import Mirroring, mirroring
from verifier.models import Array
from verifier.problem import Problem

Mask = NDArray[np.bool_]
Single = NDArray[np.float32]
#: A push beyond this picks missing rays, where they may change from step to step.
PICKS = 0.5
#: If there are more rays, only so many are tried as missing: those of the largest effect to
#: first order.
MOST_TRIED = 32


@dataclass(frozen=True)
class Attacks:
    """A batch of attacks.

    start: ``[batch, 4]`` (s, f, v, theta); push: ``[batch, steps]``, in [-1, 1]; gone:
    ``[batch, rays]``, which rays are missing (where a push does not pick others); mirror:
    ``[batch]``, the index of the segment that mirrors, or -1.
    """

    start: Array
    push: Array
    gone: Mask
    mirror: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.start)

    def take(self, index: NDArray | slice) -> Attacks:
        """Return the attacks at ``index``."""
        return Attacks(*(getattr(self, x.name)[index] for x in fields(self)))

    def repeated(self, count: int) -> Attacks:
        """Return a single attack ``count`` times."""
        return self.take(np.zeros(count, dtype=np.intp))

    @classmethod
    def join(cls, parts: list[Attacks]) -> Self:
        """Return all attacks of several batches."""
        names = [x.name for x in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(eq=False)
class Pushed:
    """What attacks make of scans, step by step (closed_loop.Disturb).

    noise, gone, lost: what was done at each step (noise, missing rays, rays that a mirror takes),
    ``[rays, batch]`` each, kept if ``keep``.
    """

    problem: Problem
    attacks: Attacks
    keep: bool = False
    noise: list[Array] = field(default_factory=list)
    gone: list[Mask] = field(default_factory=list)
    lost: list[Mask] = field(default_factory=list)

    @cached_property
    def mirrors(self) -> Mirroring | None:
        """The mirrors of the attacks."""
        return mirrors_of(self.problem, self.attacks.mirror)

    def __call__(self, step: int, state: State, scan: Array) -> Array:
        """Return the scan ``[rays, batch]`` (m) under attack."""
        given = _given(self.problem)
        controller, plant = self.problem.controller, self.problem.plant
        push = self.attacks.push[:, step]
        active = np.ones(len(state), dtype=bool)
        if given.turn_only:
            active = in_turn(state, plant.track.width)
        gone = self.attacks.gone.T & active
        lost = np.zeros_like(gone) if self.mirrors is None else self.mirrors.lost(state, scan)
        noise = np.zeros_like(scan)
        with np.errstate(all="ignore"):  # only a guess is made of what comes out here
            if given.noise:
                seen = np.where(gone | lost, plant.lidar.range, scan)
                slope = np.nan_to_num(steering_gradient(controller, seen))
                noise = given.noise * push * np.sign(slope)
            if given.missing and given.choice == "step":
                picks = np.flatnonzero(active & (np.abs(push) > PICKS))
                noisy = np.clip(scan + noise, 0.0, plant.lidar.range)
                noisy = np.where(lost, plant.lidar.range, noisy)[:, picks]
                gone[:, picks] = strongest_missing(
                    controller, noisy, np.sign(push[picks]), given.missing, plant.lidar.range
                )
        if self.keep:
            self.noise.append(noise)
            self.gone.append(gone)
            self.lost.append(lost)
        away = gone | lost
        faults = GivenFaults(plant.track.width, plant.lidar.range, away, False, noise[None])
        return faults(0, state, scan)


def _given(problem: Problem) -> Disturbance:
    if problem.disturbance is None:
        raise ValueError("the problem has no disturbance")
    return problem.disturbance


def mirrors_of(problem: Problem, chosen: ArrayLike) -> Mirroring | None:
    """Return the mirrors of runs; chosen: a segment for each run or -1. None: there are none."""
    given = problem.disturbance
    return None if given is None else mirroring(given.mirrors, problem.plant, chosen)


def steering_gradient(controller: Controller, scan: Array | Single) -> Single:
    """Return the gradient of the steering by the readings, ``[rays, batch]``; float32."""
    x, slopes = scan.astype(np.float32), []
    for layer in controller.layers:
        x, slope = _activate(layer, _sum(layer, x))
        slopes.append(slope)
    gradient = np.ones((1, scan.shape[1]), dtype=np.float32)
    for layer, slope in zip(reversed(controller.layers), reversed(slopes), strict=True):
        gradient = layer.weights.T @ (gradient * slope)
    return gradient


def strongest_missing(
    controller: Controller, scan: Array, side: Array, most: int, reach: float
) -> Mask:
    """Return which rays, if they are missing, move the steering most: ``[rays, batch]``.

    side: ``[batch]``, 1 for left, -1 for right; at most ``most`` rays each, found one after
    the other; a ray that does not help is not taken.
    """
    rays, batch = scan.shape
    gone = np.zeros((rays, batch), dtype=bool)
    if not batch:
        return gone
    first, rest = controller.layers[0], controller.layers[1:]
    x, cars = scan.astype(np.float32), np.arange(batch)
    for _ in range(most):
        change = np.float32(reach) - x
        tried = np.broadcast_to(np.arange(rays)[:, None], (rays, batch))
        if rays > MOST_TRIED:
            guess = np.nan_to_num(side * change * steering_gradient(controller, x))
            tried = np.argpartition(guess, -MOST_TRIED, axis=0)[-MOST_TRIED:]
        sums = _sum(first, x)
        every = sums[:, None] + first.weights[:, tried] * np.take_along_axis(change, tried, 0)
        steering = _finish(first, rest, every.reshape(len(sums), -1)).reshape(-1, batch)
        gain = np.nan_to_num(side * (steering - _finish(first, rest, sums)))
        best = gain.argmax(axis=0)
        helps = np.flatnonzero(gain[best, cars] > 0)
        if not helps.size:
            break
        ray = tried[best, cars]
        gone[ray[helps], helps] = True
        x[ray[helps], helps] = reach
    return gone


def _finish(first: Layer, rest: tuple[Layer, ...], sums: Single) -> Single:
    """Return the steering ``[batch]`` from the sums of the first layer."""
    x, _ = _activate(first, sums)
    for layer in rest:
        x, _ = _activate(layer, _sum(layer, x))
    return x[0]


def _sum(layer: Layer, x: Single) -> Single:
    return layer.weights @ x + layer.biases[:, None]


def _activate(layer: Layer, sums: Single) -> tuple[Single, Single]:
    """Return a layer's outputs and their derivatives by its sums."""
    if layer.activation == "tanh":
        y = np.tanh(sums)
        return y, 1 - y * y
    if layer.activation == "sigmoid":
        y = np.float32(0.5) + np.float32(0.5) * np.tanh(np.float32(0.5) * sums)
        return y, y * (1 - y)
    if layer.activation == "relu":
        return np.maximum(sums, 0), (sums > 0).astype(np.float32)
    return sums, np.ones_like(sums)

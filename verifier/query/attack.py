"""Looking for inputs that violate: uphill by the gradient, or samples that close in."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from racecar.layers import Layer
from verifier.query.network import Runner, inside, violation
from verifier.query.question import Area

Array = NDArray[np.float64]
#: Starts for each box beside its middle; steps as shares of the box's width.
_STARTS = 4
_STEPS = (1.0, 0.5, 0.5, 0.25, 0.25, 0.12, 0.12, 0.06, 0.06, 0.03, 0.03, 0.015, 0.008)
#: Samples of a box, and of what is around the best of them, round by round.
_SAMPLES, _CLOSER, _ROUNDS, _BEST = 2048, 256, 12, 4


@dataclass(frozen=True)
class Witness:
    """Inputs that violate, and by how much in the outputs' unit."""

    point: NDArray[np.float32]
    violation: float


def best_witness(runner: Runner, area: Area, points: Array) -> Witness | None:
    """Return the point that violates most, None if none does; points: ``[points, inputs]``."""
    rounded = inside(points, area)
    found = violation(runner.outputs(rounded), area)
    best = int(np.argmax(found))
    return Witness(rounded[best], float(found[best])) if found[best] >= 0 else None


def climb(
    layers: Sequence[Layer], runner: Runner, areas: Sequence[Area], deadline: float, seed: int
) -> Witness | None:
    """Follow the sign of the gradient of every condition from several starts in every box."""
    random = np.random.default_rng(seed)
    for area in areas:
        wide = area.upper - area.lower
        shares = [np.full(len(wide), 0.5), *random.uniform(size=(_STARTS, len(wide)))]
        for factors in np.unique(area.factors, axis=0):
            x = area.lower + np.array(shares) * wide
            met = [x]
            for step in _STEPS:
                slope = _slope(layers, x, factors)
                x = np.clip(x - step * wide * np.sign(slope), area.lower, area.upper)
                met.append(x)
            found = best_witness(runner, area, np.concatenate(met))
            if found is not None:
                return found
            if time.monotonic() > deadline:
                return None
    return None


def _slope(layers: Sequence[Layer], x: Array, factors: Array) -> Array:
    """Return the gradient ``[points, inputs]`` of ``factors . outputs`` at ``[points, inputs]``."""
    slopes, y = [], x
    for layer in layers:
        y = y @ layer.weights.T.astype(float) + layer.biases
        if layer.activation == "tanh":
            y = np.tanh(y)
            slopes.append(1 - y * y)
        elif layer.activation == "sigmoid":
            y = 0.5 + 0.5 * np.tanh(0.5 * y)
            slopes.append(y * (1 - y))
        elif layer.activation == "relu":
            slopes.append((y > 0).astype(float))
            y = np.maximum(y, 0)
        else:
            slopes.append(np.ones_like(y))
    back = np.broadcast_to(factors, slopes[-1].shape)
    for layer, slope in zip(reversed(layers), reversed(slopes), strict=True):
        back = (back * slope) @ layer.weights.astype(float)
    return back


def close_in(runner: Runner, areas: Sequence[Area], deadline: float, seed: int) -> Witness | None:
    """Sample every box, then around the best samples, closer and closer."""
    random = np.random.default_rng(seed)
    for area in areas:
        wide = area.upper - area.lower
        points = area.lower + _shares(random, np.flatnonzero(wide > 0), len(wide)) * wide
        for k in range(_ROUNDS):
            rounded = inside(points, area)
            found = violation(runner.outputs(rounded), area)
            order = np.argsort(-found)[:_BEST]
            if found[order[0]] >= 0:
                return Witness(rounded[order[0]], float(found[order[0]]))
            if time.monotonic() > deadline:
                return None
            best = rounded[order].astype(float)
            around = (
                random.uniform(-1, 1, size=(_CLOSER, len(best), len(wide))) * wide * 0.5 ** (k + 2)
            )
            points = np.concatenate([best, (best + around).reshape(-1, len(wide))])
    return None


def _shares(random: np.random.Generator, varied: NDArray[np.intp], inputs: int) -> Array:
    """Return samples of the unit box: corners, a line if one input varies, and random ones."""
    count = _SAMPLES
    shares = np.full((count, inputs), 0.5)
    if len(varied) == 1:
        shares[:, varied[0]] = np.linspace(0, 1, count)
        return shares
    shares[:, varied] = random.uniform(size=(count, len(varied)))
    corners = count // 4
    shares[:corners, varied] = random.integers(0, 2, size=(corners, len(varied)))
    return shares

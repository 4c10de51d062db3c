"""How far a controller's steering can be pushed within a set of scans: a gradient search.

What it finds is attained, so it bounds the true extremes from one side. Thresholds are derived
from it, no answer is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from generator.openloop.spec import Box
from racecar.controller import Controller, Layer
from racecar.polygon import Array

#: Starts per box beside its centre; steps of the search as shares of the box's width.
_STARTS = 3
_STEPS = (1.0, 1.0, 0.5, 0.5, 0.25, 0.25, 0.12, 0.12, 0.06, 0.06, 0.03, 0.03)


def steering_extremes(controller: Controller, boxes: Sequence[Box]) -> tuple[float, float]:
    """Return the least and the largest steering (rad) found in a union of boxes (m)."""
    lower = np.array([box.lower for box in boxes], dtype=float).T
    upper = np.array([box.upper for box in boxes], dtype=float).T
    random = np.random.default_rng(0)
    shares = [np.full(lower.shape, 0.5)]
    shares += [random.uniform(size=lower.shape) for _ in range(_STARTS)]
    start = np.concatenate([lower + share * (upper - lower) for share in shares], axis=1)
    lower, upper = np.tile(lower, len(shares)), np.tile(upper, len(shares))
    least, most = (_push(controller, start, lower, upper, sign) for sign in (-1.0, 1.0))
    return -least, most


def steering_limit(controller: Controller) -> float:
    """Return a bound on the steering's absolute value (rad) over all inputs; maybe infinite."""
    limit = np.full(controller.rays, np.inf)
    for layer in controller.layers:
        with np.errstate(invalid="ignore"):  # a weight of 0 times infinity
            reach = np.abs(layer.weights.astype(float)) @ limit + np.abs(layer.biases)
        reach = np.where(np.isnan(reach), np.inf, reach)
        # |tanh x| <= |x| as well; a sigmoid is 1/2 at 0.
        most = {"tanh": np.minimum(reach, 1.0), "sigmoid": np.ones_like(reach)}
        limit = most.get(layer.activation, reach)
    return float(limit[0])


def influence(controller: Controller, scan: Array) -> Array:
    """Return the derivative of the steering by each ray (rad/m) at a scan ``[rays]`` (m)."""
    return _gradient(controller, scan[:, None])[1][:, 0]


def _push(controller: Controller, x: Array, lower: Array, upper: Array, sign: float) -> float:
    """Return the largest of ``sign * steering`` met on the way uphill from every column of x."""
    best = -np.inf
    for share in _STEPS:
        value, slope = _gradient(controller, x)
        best = max(best, float(np.max(sign * value)))
        x = np.clip(x + share * (upper - lower) * np.sign(sign * slope), lower, upper)
    return max(best, float(np.max(sign * controller.steering_rows(x))))


def _gradient(controller: Controller, x: Array) -> tuple[Array, Array]:
    """Return the steering ``[batch]`` at scans ``[rays, batch]`` and its gradient, alike."""
    slopes, y = [], x
    for layer in controller.layers:
        y = layer.weights.astype(float) @ y + layer.biases.astype(float)[:, None]
        y, slope = _activate(layer, y)
        slopes.append(slope)
    back = np.ones_like(y)
    for layer, slope in zip(reversed(controller.layers), reversed(slopes), strict=True):
        back = layer.weights.astype(float).T @ (back * slope)
    return y[0], back


def _activate(layer: Layer, y: Array) -> tuple[Array, Array]:
    """Return an activation's value and its derivative."""
    if layer.activation == "tanh":
        out = np.tanh(y)
        return out, 1 - out**2
    if layer.activation == "sigmoid":
        out = 0.5 + 0.5 * np.tanh(0.5 * y)
        return out, out * (1 - out)
    if layer.activation == "relu":
        return np.maximum(y, 0), (y > 0).astype(float)
    return y, np.ones_like(y)

"""Lower bounds of what a chain of layers gives, over many boxes at once, with rounding proved.

A linear function of the outputs is carried back through the layers: by a matrix through a layer's
sum, by a line below or above through its activation. At the inputs it is least at a corner. The
lines need bounds of every neuron's sum, which are found in the same way, layer by layer.

All is done in doubles. A functional at some layer is  given + (numbers, exactly as stored) . (the
layer's exact values) + offset, and the value that it stands for is at least this, less ``short``:
whatever was rounded on the way is in ``short``, as a multiple of the sum of the absolute values of
all that was added up. An inner product of n terms errs by n 2^-53 / (1 - n 2^-53) of that in any
order of summation, with fused operations or without.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from checker.files import Layer
from checker.query.lines import Lines, linear_lines, relu_lines, sigmoid_lines, tanh_lines

Array = NDArray[np.float64]

_LINES: dict[str, Callable[[Array, Array], Lines]] = {
    "Tanh": tanh_lines,
    "Sigmoid": sigmoid_lines,
    "Relu": relu_lines,
    "": linear_lines,
}
#: Products may underflow: each errs by less than 2^-1074, times later factors.
_TINY = 2.0**-500
#: Numbers that boxes are bounded with at a time, about.
_ROOM = 4_000_000


def _gamma(terms: int) -> float:
    """Return twice what an inner product errs by: room for the rounding of bounds themselves."""
    return 2 * (terms + 4) * 2.0**-53


@dataclass(frozen=True, eq=False)
class _Sum:
    """A layer: weights ``[out, in]`` and biases as doubles, exactly; absolute: of the weights."""

    weights: Array
    absolute: Array
    biases: Array
    lines: Callable[[Array, Array], Lines]


@dataclass(frozen=True, eq=False)
class _Bounds:
    """Of a layer on each box, ``[boxes, neurons]``: lines, and how large sums and values get."""

    lines: Lines
    sums: Array
    values: Array


class Chain:
    """The real-valued function of the float32 weights of a chain of layers."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        self._layers = []
        for layer in layers:
            weights = layer.weights.astype(np.float64)
            biases = layer.biases.astype(np.float64)
            self._layers.append(_Sum(weights, np.abs(weights), biases, _LINES[layer.activation]))
        self.inputs, self.outputs = layers[0].weights.shape[1], len(layers[-1].weights)

    def least(self, lower: Array, upper: Array, factors: Array) -> Array:
        """Return lower bounds ``[boxes, sums]`` of sums of multiples of the outputs.

        lower, upper: of boxes, ``[boxes, inputs]``; factors: ``[sums, outputs]``. NaN: no bound.
        """
        widest = max(len(layer.weights) for layer in self._layers)
        at_a_time = max(1, _ROOM // (2 * widest * max(widest, self.inputs)))
        pieces = [slice(k, k + at_a_time) for k in range(0, len(lower), at_a_time)]
        with np.errstate(all="ignore"):
            found = [self._least(lower[piece], upper[piece], factors) for piece in pieces]
        return np.concatenate(found) if found else np.empty((0, len(factors)))

    def _least(self, lower: Array, upper: Array, factors: Array) -> Array:
        middle = 0.5 * lower + 0.5 * upper
        # Rounded up: the box is within.
        half = np.maximum(upper - middle, middle - lower) * (1 + 2.0**-50) + _TINY
        box = middle, half, np.maximum(np.abs(lower), np.abs(upper))
        known: list[_Bounds] = []
        for layer in self._layers:
            both = np.concatenate([layer.weights, -layer.weights])
            shift = np.concatenate([layer.biases, -layer.biases])
            least = self._back(both, shift, known, box)
            low, high = np.split(least, 2, axis=1)
            high = -high
            known.append(_bounds(layer, low, high))
        return self._back(factors, np.zeros(len(factors)), known, box)

    def _back(
        self, factors: Array, shift: Array, known: list[_Bounds], box: tuple[Array, Array, Array]
    ) -> Array:
        """Return lower bounds of ``factors . values + shift``, values: of the last known layer."""
        middle, half, size = box
        boxes = len(middle)
        row = np.broadcast_to(factors, (boxes, *factors.shape))
        offset = np.broadcast_to(shift, (boxes, len(shift)))
        short = np.zeros((boxes, len(shift)))
        for i in range(len(known) - 1, -1, -1):
            layer, here = self._layers[i], known[i]
            before = known[i - 1].values if i else size
            below, drop, above, rise = (x[:, None, :] for x in here.lines)
            falls = row < 0
            absolute = np.abs(row)
            # Through the activation; a product is rounded once.
            bends = np.where(falls, rise, drop)
            added = (row * bends).sum(axis=2)
            spread = (absolute * np.abs(bends)).sum(axis=2)
            row = row * np.where(falls, above, below)
            absolute = np.abs(row)
            spread += _product(absolute, here.sums)
            # Through the sum.
            added += row @ layer.biases
            inner = before @ layer.absolute.T + np.abs(layer.biases)
            spread += _product(absolute, inner)
            spread += np.abs(offset) + np.abs(added)
            offset = offset + added
            short += _gamma(max(layer.weights.shape)) * spread + _TINY
            row = row @ layer.weights
        absolute = np.abs(row)
        reach = _product(absolute, half)
        centre = _product(row, middle)
        spread = _product(absolute, size) + reach + np.abs(offset) + np.abs(centre)
        short += _gamma(self.inputs) * spread + _TINY
        least: Array = ((centre + offset) - reach) - short
        return least - 2.0**-52 * np.abs(least)


def _bounds(layer: _Sum, low: Array, high: Array) -> _Bounds:
    sums = np.maximum(np.abs(low), np.abs(high))
    # |tanh(z)|, |sigmoid(z)| and |max(z, 0)| are at most 1 or |z|.
    values = sums if layer.lines in (relu_lines, linear_lines) else np.ones_like(sums)
    return _Bounds(layer.lines(low, high), sums, values)


def _product(rows: Array, column: Array) -> Array:
    """Return rows ``[boxes, m, n]`` times a vector ``[boxes, n]`` for each box."""
    product: Array = (rows @ column[:, :, None])[:, :, 0]
    return product

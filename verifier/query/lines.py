"""Bounds of a controller over many boxes at once: lines through each neuron, carried backwards.

Zhang et al., "Efficient neural network robustness certification with general activation
functions" (CROWN), NeurIPS 2018. In plain doubles: what comes out guides a search and proves
nothing; that is the checker's part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from racecar.layers import Layer

Array = NDArray[np.float64]
#: Boxes are bounded in batches of about so many numbers.
_ROOM = 2_000_000


@dataclass(frozen=True, eq=False)
class Bounded:
    """What is known of some boxes.

    least: lower bounds of each wanted sum ``[boxes, sums]``; corner: the inputs at which the
    linear bound of each is least ``[boxes, sums, inputs]``; loss: how much of each bound the
    lines cost, shared out to the inputs by how far they move the neurons, alike.
    """

    least: Array
    corner: Array
    loss: Array


class Lines:
    """A chain of layers, ready to be bounded."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        self._weights = [layer.weights.astype(float) for layer in layers]
        self._biases = [layer.biases.astype(float) for layer in layers]
        self._kinds = [layer.activation for layer in layers]

    def bound(self, lower: Array, upper: Array, factors: Array) -> Bounded:
        """Bound ``factors . outputs`` from below on boxes ``[boxes, inputs]``."""
        widest = max(len(w) for w in self._weights)
        step = max(1, _ROOM // (widest * max(widest, lower.shape[1])))
        parts = [
            self._bound(lower[k : k + step], upper[k : k + step], factors)
            for k in range(0, len(lower), step)
        ]
        least, corner, loss = zip(*parts, strict=True)
        return Bounded(np.concatenate(least), np.concatenate(corner), np.concatenate(loss))

    def _bound(self, lower: Array, upper: Array, factors: Array) -> tuple[Array, Array, Array]:
        middle, half = (lower + upper) / 2, (upper - lower) / 2
        lines: list[tuple[Array, ...]] = []
        shares: list[Array] = []
        for i, (weights, biases) in enumerate(zip(self._weights, self._biases, strict=True)):
            row, low, _ = self._back(weights, lines, True)
            other, high, _ = (row, low, None) if i == 0 else self._back(weights, lines, False)
            z_low = row @ middle[:, :, None] - np.abs(row) @ half[:, :, None]
            z_high = other @ middle[:, :, None] + np.abs(other) @ half[:, :, None]
            z_low, z_high = z_low[:, :, 0] + low + biases, z_high[:, :, 0] + high + biases
            moved = np.abs(row) * half[:, None, :]
            shares.append(moved / np.maximum(moved.sum(axis=2, keepdims=True), 1e-300))
            lines.append(_activation_lines(self._kinds[i], z_low, z_high))
        row, offset, costs = self._back(factors, lines, True)
        least = (row @ middle[:, :, None])[:, :, 0] - (np.abs(row) @ half[:, :, None])[:, :, 0]
        corner = np.where(row > 0, lower[:, None, :], upper[:, None, :])
        loss = np.zeros_like(corner)
        for cost, share in zip(reversed(costs), shares, strict=True):
            loss += cost @ share
        return least + offset, corner, loss

    def _back(
        self, factors: Array, lines: Sequence[tuple[Array, ...]], below: bool
    ) -> tuple[Array, Array, list[Array]]:
        """Carry ``factors . values`` back to the inputs: a matrix and an offset for each box.

        The last list says what each line costs at most, last layer first.
        """
        boxes = len(lines[0][0]) if lines else 1
        row = np.broadcast_to(factors, (boxes, *factors.shape))
        offset: Array = np.zeros((boxes, len(factors)))
        costs = []
        for i in range(len(lines) - 1, -1, -1):
            k_low, b_low, k_high, b_high, gap = (x[:, None, :] for x in lines[i])
            falls = row < 0 if below else row > 0
            costs.append(np.abs(row) * gap)
            offset = offset + (row * np.where(falls, b_high, b_low)).sum(axis=2)
            row = row * np.where(falls, k_high, k_low)
            offset = offset + row @ self._biases[i]
            row = row @ self._weights[i]
        return row, offset, costs


def _activation_lines(kind: str, low: Array, high: Array) -> tuple[Array, ...]:
    """Return slope and intercept of a line below and of one above, and how far they are apart."""
    if kind == "relu":
        mixed = (low < 0) & (high > 0)
        share = np.where(mixed, high / np.where(mixed, high - low, 1), low >= 0)
        rise = np.where(mixed, -share * low, 0)
        return np.where(mixed, high > -low, share) * 1.0, 0 * low, share, rise, rise
    if kind not in ("tanh", "sigmoid"):
        return np.ones_like(low), 0 * low, np.ones_like(low), 0 * low, 0 * low
    scale, shift = (0.5, 0.5) if kind == "sigmoid" else (1.0, 0.0)
    low, high = scale * low, scale * high
    k_high, b_high = _above_tanh(low, high)
    k_low, b_low = _above_tanh(-high, -low)
    gaps = [(k_high - k_low) * end + b_high + b_low for end in (low, high)]
    gap = np.maximum(*gaps) * scale
    return k_low * scale**2, shift - scale * b_low, k_high * scale**2, shift + scale * b_high, gap


def _above_tanh(low: Array, high: Array) -> tuple[Array, Array]:
    """Return a line above tanh: the chord, or a tangent (through the lower end if that is < 0)."""
    at_low, at_high = np.tanh(low), np.tanh(high)
    touch = np.clip(0.3 - 0.5 * low, 0.3, 20.0)
    for _ in range(8):
        t = np.tanh(touch)
        steep = 1 - t * t
        fall = t - at_low - steep * (touch - low)
        touch = np.clip(touch - fall / np.maximum(2 * t * steep * (touch - low), 1e-12), 0.0, 20.0)
    touch = np.where(low >= 0, (low + high) / 2, touch)
    t = np.tanh(touch)
    slope = 1 - t * t
    chord = (low < 0) & (touch >= high)
    flat = high - low < 1e-9
    quotient = (at_high - at_low) / np.where(flat, 1.0, high - low)
    slope = np.where(chord, np.where(flat, 1 - at_low**2, quotient), slope)
    return slope, np.where(chord, at_low - slope * low, t - slope * touch)

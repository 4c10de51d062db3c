"""From a trained Stable-Baselines3 actor to a controller file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.controller import Controller, weights_sha256
from racecar.layers import Convolution, Layer

MAX_STEERING = math.radians(15)
SCAN_CENTRE, SCAN_SCALE = 2.5, 5.0


def fold(
    layers: Sequence[tuple[ArrayLike, ArrayLike, str]],
    metadata: dict[str, str],
    convolutions: Sequence[tuple[Convolution, str]] = (),
) -> Controller:
    """Return the controller of a network that reads ``(scan - 2.5) / 5`` and gives [-1, 1].

    layers: (weights ``[out, in]``, biases ``[out]``, activation); convolutions: with their
    activations, before them. Normalisation goes into the first of all and the factor of 15
    degrees into a last linear layer, computed in float64 and rounded once to float32. A hash of
    the layers is added to the metadata.
    """
    folded: list[Layer] = []
    for convolution, activation in convolutions:
        w, b = _normalised(convolution.kernels, convolution.biases, first=not folded)
        folded.append(replace(convolution, kernels=w, biases=b).layer(activation))
    for weights, biases, activation in layers:
        folded.append(Layer(*_normalised(weights, biases, first=not folded), activation))
    scale: NDArray[np.float32] = np.array([[MAX_STEERING]], dtype=np.float32)
    folded.append(Layer(scale, np.zeros(1, dtype=np.float32), "linear"))
    sha256 = weights_sha256(Controller(tuple(folded)))
    return Controller(tuple(folded), metadata | {"weights_sha256": sha256})


def _normalised(
    weights: ArrayLike, biases: ArrayLike, first: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return weights ``[out, ...]`` and biases ``[out]``, the first layer's for distances in m."""
    w, b = np.asarray(weights, dtype=float), np.asarray(biases, dtype=float).reshape(-1)
    if first:
        b = b - (SCAN_CENTRE / SCAN_SCALE) * w.reshape(len(w), -1).sum(axis=1)
        w = w / SCAN_SCALE
    return w.astype(np.float32), b.astype(np.float32)

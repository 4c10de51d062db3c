"""From a trained Stable-Baselines3 actor to a controller file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.controller import Controller, Layer, weights_sha256

MAX_STEERING = math.radians(15)
SCAN_CENTRE, SCAN_SCALE = 2.5, 5.0


def fold(
    layers: Sequence[tuple[ArrayLike, ArrayLike, str]], metadata: dict[str, str]
) -> Controller:
    """Return the controller of a network that reads ``(scan - 2.5) / 5`` and gives [-1, 1].

    layers: (weights ``[out, in]``, biases ``[out]``, activation). Normalisation goes into
    the first layer and the factor of 15 degrees into a last linear layer, computed in
    float64 and rounded once to float32. A hash of the layers is added to the metadata.
    """
    folded = []
    for i, (weights, biases, activation) in enumerate(layers):
        w, b = np.asarray(weights, dtype=float), np.asarray(biases, dtype=float).reshape(-1)
        if i == 0:
            b = b - (SCAN_CENTRE / SCAN_SCALE) * w.sum(axis=1)
            w = w / SCAN_SCALE
        folded.append(Layer(w.astype(np.float32), b.astype(np.float32), activation))
    scale: NDArray[np.float32] = np.array([[MAX_STEERING]], dtype=np.float32)
    folded.append(Layer(scale, np.zeros(1, dtype=np.float32), "linear"))
    sha256 = weights_sha256(Controller(tuple(folded)))
    return Controller(tuple(folded), metadata | {"weights_sha256": sha256})

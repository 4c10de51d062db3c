"""Controllers on Taylor models: scans in, steering out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from racecar.controller import Controller
from verifier.functions import relu, sigmoid, tanh
from verifier.models import Array, Models, linear

_ACTIVATIONS = {"tanh": tanh, "sigmoid": sigmoid, "relu": relu, "linear": lambda z: z}


@dataclass(frozen=True)
class _Layer:
    weights: Array  # [out, in]: the float32 weights as doubles, exactly
    absolute: Array
    biases: Array  # [out, 1]
    activation: str


class Network:
    """The real-valued function of a controller's float32 weights."""

    def __init__(self, controller: Controller) -> None:
        self._layers = [
            _Layer(
                w := x.weights.astype(float),
                np.abs(w),
                x.biases.astype(float)[:, None],
                x.activation,
            )
            for x in controller.layers
        ]

    def steering(self, scan: Models) -> Models:
        """Return models ``[rows]`` of the steering (rad) for models ``[rays, rows]`` (m)."""
        z = scan
        for layer in self._layers:
            z = linear(layer.weights, layer.absolute, z).plus(layer.biases)
            z = _ACTIVATIONS[layer.activation](z)
        return z[0]

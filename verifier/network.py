"""Controllers on Taylor models: scans in, steering out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from racecar.controller import Controller
from verifier.arithmetic import Model, norm, read
from verifier.chords import wide_sigmoid, wide_tanh
from verifier.compiled.kernel import kernel
from verifier.compiled.trace import Trace, Value
from verifier.functions import relu, sigmoid, tanh
from verifier.models import TERMS, Array, Models
from verifier.rounding import TINY, UP, U, gamma
from verifier.walls import grid

_ACTIVATIONS = {"tanh": tanh, "sigmoid": sigmoid, "relu": relu, "linear": lambda z: z}
#: Where an error symbol moves a neuron's argument by more than WIDE.
_WIDE_ACTIVATIONS = {**_ACTIVATIONS, "tanh": wide_tanh, "sigmoid": wide_sigmoid}
WIDE = 0.01


@dataclass(frozen=True)
class _Layer:
    weights: Array  # [in, out]: the float32 weights as doubles, exactly
    absolute: Array
    biases: Array  # [out]
    activation: str
    rounding: float  # of an inner product, relative to that of absolute values


class Network:
    """The real-valued function of a controller's float32 weights."""

    def __init__(self, controller: Controller) -> None:
        self._layers = [
            _Layer(
                w := np.ascontiguousarray(x.weights.T, dtype=float),
                np.abs(w),
                x.biases.astype(float),
                x.activation,
                gamma(len(w) + 1),
            )
            for x in controller.layers
        ]

    def steering(self, scan: Models) -> Models:
        """Return models ``[rows]`` of the steering (rad) for models ``[rays, rows]`` (m)."""
        width, rows = len(scan.c), scan.radius.shape[-1]
        rays = scan.radius.size // rows
        # Neurons last, so that a layer is one product of matrices.
        row, ray = grid(rows, rays)
        tables = [scan.c.reshape(width, -1), scan.radius.reshape(1, -1)]
        out = _inputs(scan.symbols)(rays * rows, tables, [ray * rows + row])
        c, (radius, size) = out[:width], out[width:].reshape(2, rows, -1)
        for layer in self._layers:
            # As verifier.models.linear does, and adds the biases.
            c = c.reshape(width * rows, -1) @ layer.weights
            c[:rows] += layer.biases
            noise = (radius + layer.rounding * size) @ layer.absolute
            noise *= (1 + 2 * layer.rounding) * UP
            tables = [c.reshape(width, -1), noise.reshape(1, -1)]
            symbols = c[TERMS * rows :: 2]
            wide = bool(symbols.size) and max(symbols.max(), -symbols.min()) > WIDE
            out = _neurons(scan.symbols, layer.activation, wide)(noise.size, tables)
            c = out[:width]
            radius, size = out[width:].reshape(2, rows, -1)
        return Models(c.reshape(width, rows, -1)[:, :, 0], radius[:, 0])


@kernel
def _inputs(trace: Trace, symbols: int) -> list[Value]:
    """A measurement, put elsewhere, and the size of its coefficients."""
    distance = read(trace, symbols, trace.index())
    return [*distance.values, norm(distance)]


@kernel
def _neurons(trace: Trace, symbols: int, activation: str, wide: bool) -> list[Value]:
    """A neuron's output, and the size of its coefficients, from its rounded sum and noise."""
    c = trace.table(TERMS + 2 * symbols)
    radius = trace.column() * UP + TINY
    # The bias was added: one rounding.
    functions = _WIDE_ACTIVATIONS if wide else _ACTIVATIONS
    result = functions[activation](Model(c, (radius + U * abs(c[0])) * UP))
    return [*result.values, norm(result)]

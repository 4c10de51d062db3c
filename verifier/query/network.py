"""The network of a question as onnxruntime computes it, and how far inputs are from violating."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.query.network import unpack
from racecar.controller import open_session
from racecar.errors import BadInput
from verifier.query.question import Area

Array = NDArray[np.float64]
#: Inputs that are computed at a time.
_AT_A_TIME = 4096


class Runner:
    """A network of one input and one output tensor of float32."""

    def __init__(self, content: bytes, where: str) -> None:
        self._session = open_session(unpack(content, where), where)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1 or inputs[0].type != "tensor(float)":
            raise BadInput(f"{where}: it must have one input and one output, of float32")
        self._name, self._shape = inputs[0].name, inputs[0].shape

    def outputs(self, points: NDArray[np.float32]) -> Array:
        """Return the outputs ``[points, outputs]`` at inputs ``[points, inputs]``."""
        many = not isinstance(self._shape[0], int)
        step = _AT_A_TIME if many else 1
        found = [self._run(points[k : k + step]) for k in range(0, len(points), step)]
        return np.concatenate(found)

    def _run(self, points: NDArray[np.float32]) -> Array:
        shape = [n if isinstance(n, int) and n > 0 else 1 for n in self._shape[1:]]
        (out,) = self._session.run(None, {self._name: points.reshape(len(points), *shape)})
        array: NDArray[Any] = np.asarray(out, dtype=float)
        return array.reshape(len(points), -1)


def inside(points: Array, area: Area) -> NDArray[np.float32]:
    """Return the nearest float32 inputs within an area's box."""
    lower, upper = area.lower.astype(np.float32), area.upper.astype(np.float32)
    lower = np.where(lower < area.lower, np.nextafter(lower, np.float32(np.inf)), lower)
    upper = np.where(upper > area.upper, np.nextafter(upper, np.float32(-np.inf)), upper)
    clipped: NDArray[np.float32] = np.clip(points.astype(np.float32), lower, upper)
    return clipped


def violation(outputs: Array, area: Area) -> Array:
    """Return by how much outputs ``[points, outputs]`` violate at best (negative: not)."""
    met = area.most - outputs @ area.factors.T
    worst = np.full((len(outputs), area.alternative.max() + 1), np.inf)
    for row, alternative in enumerate(area.alternative):
        worst[:, alternative] = np.minimum(worst[:, alternative], met[:, row])
    most: Array = worst.max(axis=1)
    return np.where(np.isfinite(most), most, -np.inf)

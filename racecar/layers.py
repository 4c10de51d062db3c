"""The layers of a controller: each a matrix, a vector and an activation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Convolution:
    """A convolution along a scan or along what another one made of it, without padding.

    kernels: float32 ``[channels out, channels in, width]``; biases: float32 ``[channels out]``;
    stride: places from one window to the next; length: places of each channel of its input.
    Input and output are flat: all places of the first channel, then of the second, ...
    """

    kernels: NDArray[np.float32]
    biases: NDArray[np.float32]
    stride: int
    length: int

    @property
    def places(self) -> int:
        """Places of each channel of its output."""
        return (self.length - self.kernels.shape[2]) // self.stride + 1

    def dense(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return it as weights ``[out, in]``, the kernels' numbers and zeros, and biases."""
        out, channels, width = self.kernels.shape
        weights = np.zeros((out, self.places, channels, self.length), dtype=np.float32)
        for place in range(self.places):
            first = place * self.stride
            weights[:, place, :, first : first + width] = self.kernels
        rows = weights.reshape(out * self.places, channels * self.length)
        return rows, np.repeat(self.biases, self.places)

    def layer(self, activation: str) -> Layer:
        """Return it as a layer."""
        return Layer(*self.dense(), activation, self)


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer: ``activation(weights @ x + biases)``.

    weights: float32 ``[out, in]``; biases: float32 ``[out]``; activation: "tanh",
    "sigmoid", "relu" or "linear"; convolution: what the weights and biases spell out, if they
    come from one. Only files know convolutions: all else reads the weights. Raises ValueError
    if the two do not say the same.
    """

    weights: NDArray[np.float32]
    biases: NDArray[np.float32]
    activation: str
    convolution: Convolution | None = None

    def __post_init__(self) -> None:
        if self.convolution is not None:
            given = self.weights, self.biases
            if not all(map(np.array_equal, given, self.convolution.dense())):
                raise ValueError("a layer's weights are not those of its convolution")

"""The network that learns: tanh everywhere, on (scan - 2.5) / 5, as the paper's controllers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn

from generator.actor import SCAN_CENTRE, SCAN_SCALE, fold
from racecar.controller import Controller


class Student(nn.Module):
    """A fully connected network from a scan (m) to steering / 15 degrees."""

    def __init__(self, rays: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.layers: Sequence[nn.Linear] = nn.ModuleList(  # type: ignore[assignment]
            nn.Linear(a, b) for a, b in pairwise([rays, *hidden, 1])
        )

    def forward(self, scan: torch.Tensor) -> torch.Tensor:
        """Return the steering ``[batch]``, in [-1, 1], for scans ``[batch, rays]``."""
        value = (scan - SCAN_CENTRE) / SCAN_SCALE
        for layer in self.layers:
            value = torch.tanh(layer(value))
        return value[:, 0]

    def with_gain(self, scan: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the steering and its gain ``[batch]``, per metre.

        The gain is the L1 norm of the gradient: how fast the steering can change when
        every reading changes at once by the worst of small amounts. It is computed along with
        the steering, so that it can itself be differentiated at the price of one more pass.
        """
        value, slopes = (scan - SCAN_CENTRE) / SCAN_SCALE, []
        for layer in self.layers:
            value = torch.tanh(layer(value))
            slopes.append(1 - value * value)
        back = slopes.pop()
        weights = [layer.weight for layer in self.layers]
        for slope in reversed(slopes):
            back = (back @ weights.pop()) * slope
        return value[:, 0], (back @ weights.pop()).abs().sum(dim=1) / SCAN_SCALE

    def controller(self, metadata: dict[str, str]) -> Controller:
        """Return the controller of this network."""
        layers = [
            (layer.weight.detach().numpy(), layer.bias.detach().numpy(), "tanh")
            for layer in self.layers
        ]
        return fold(layers, metadata)

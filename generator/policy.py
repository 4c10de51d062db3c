"""The networks of a training: what actor and critics make of a scan."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from generator.actor import SCAN_CENTRE, SCAN_SCALE


class NormalisedScan(BaseFeaturesExtractor):
    """Scans as the networks read them: (distance - 2.5 m) / 5 m, of every ``stride``-th ray."""

    def __init__(self, observation_space: gymnasium.spaces.Box, stride: int = 1) -> None:
        super().__init__(observation_space, len(range(0, observation_space.shape[0], stride)))
        self.stride = stride

    def forward(self, scan: torch.Tensor) -> torch.Tensor:
        """Normalise ``[batch, rays]``."""
        return (scan[:, :: self.stride] - SCAN_CENTRE) / SCAN_SCALE


class RacecarPolicy(TD3Policy):
    """TD3's policy with an activation of its own for the critics, which may read fewer rays."""

    def __init__(
        self,
        *args: Any,
        critic_activation: type[nn.Module],
        critic_rays: int | None = None,
        **kwargs: Any,
    ) -> None:
        self._critic_activation = critic_activation
        self._critic_rays = critic_rays
        super().__init__(*args, **kwargs)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Make a critic."""
        self.critic_kwargs["activation_fn"] = self._critic_activation
        space = self.observation_space
        assert isinstance(space, gymnasium.spaces.Box)
        intervals = space.shape[0] - 1
        stride = max(1, intervals // (self._critic_rays - 1)) if self._critic_rays else 1
        return super().make_critic(features_extractor or NormalisedScan(space, stride))

"""The networks of a training: what actor and critics make of a scan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from generator.actor import SCAN_CENTRE, SCAN_SCALE
from generator.hyperparams import ConvolutionArguments
from racecar.errors import BadInput


class NormalisedScan(BaseFeaturesExtractor):
    """Scans as the networks read them: (distance - 2.5 m) / 5 m, of every ``stride``-th ray."""

    def __init__(self, observation_space: gymnasium.spaces.Box, stride: int = 1) -> None:
        super().__init__(observation_space, len(range(0, observation_space.shape[0], stride)))
        self.stride = stride

    def forward(self, scan: torch.Tensor) -> torch.Tensor:
        """Normalise ``[batch, rays]``."""
        return (scan[:, :: self.stride] - SCAN_CENTRE) / SCAN_SCALE


class ConvolvedScan(BaseFeaturesExtractor):
    """What convolutions along the scan make of it, flat."""

    def __init__(
        self,
        observation_space: gymnasium.spaces.Box,
        convolutions: Sequence[ConvolutionArguments],
        activation: type[nn.Module],
    ) -> None:
        rays = observation_space.shape[0]
        channels, places = 1, rays
        layers: list[nn.Module] = []
        for x in convolutions:
            if places < x.kernel:
                raise BadInput(
                    f"convolution with a kernel of {x.kernel}: only {places} places are left; "
                    "make kernels or strides smaller"
                )
            layers += [nn.Conv1d(channels, x.channels, x.kernel, x.stride), activation()]
            channels, places = x.channels, (places - x.kernel) // x.stride + 1
        super().__init__(observation_space, channels * places)
        self.rays, self.layers = rays, nn.Sequential(*layers)

    def forward(self, scan: torch.Tensor) -> torch.Tensor:
        """Normalise and convolve ``[batch, rays]``."""
        return self.layers((scan[:, None] - SCAN_CENTRE) / SCAN_SCALE).flatten(1)


class RacecarPolicy(TD3Policy):
    """TD3's policy with critics of their own activation, which may read fewer rays.

    convolutions: if any, the actor's first layers.
    """

    def __init__(
        self,
        *args: Any,
        critic_activation: type[nn.Module],
        critic_rays: int | None = None,
        convolutions: Sequence[ConvolutionArguments] = (),
        **kwargs: Any,
    ) -> None:
        self._critic_activation = critic_activation
        self._critic_rays = critic_rays
        self._convolutions = convolutions
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Make an actor."""
        if self._convolutions and features_extractor is None:
            assert isinstance(self.observation_space, gymnasium.spaces.Box)
            features_extractor = ConvolvedScan(
                self.observation_space, self._convolutions, self.activation_fn
            )
        return super().make_actor(features_extractor)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Make a critic."""
        self.critic_kwargs["activation_fn"] = self._critic_activation
        space = self.observation_space
        assert isinstance(space, gymnasium.spaces.Box)
        intervals = space.shape[0] - 1
        stride = max(1, intervals // (self._critic_rays - 1)) if self._critic_rays else 1
        return super().make_critic(features_extractor or NormalisedScan(space, stride))

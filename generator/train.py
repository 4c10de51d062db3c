"""Training with Stable-Baselines3: seeded, in chunks, resumable after each chunk.

A training that was interrupted and resumed gives the same controller, byte for byte, as one
that was not: a checkpoint holds networks, optimisers, replay buffer, environment and the
state of every random generator.
"""

from __future__ import annotations

import csv
import io
import json
import platform
import random
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

import racecar.env
from generator.actor import SCAN_CENTRE, SCAN_SCALE, fold
from generator.hyperparams import ENVIRONMENT, Hyperparameters, load_hyperparameters
from generator.nominal import Nominal, drive_nominal
from generator.setups import Setup
from racecar.controller import Controller, write_whole

CHUNK = 5000
_ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU}
LIBRARIES = ("stable-baselines3", "torch", "gymnasium", "numpy")
#: How far (rad) the exported network may stray from the torch actor: float32 rounding.
EXPORT_TOLERANCE = 1e-5


class NormalisedScan(BaseFeaturesExtractor):
    """Scans as the networks read them: (distance - 2.5 m) / 5 m."""

    def __init__(self, observation_space: gymnasium.spaces.Box) -> None:
        super().__init__(observation_space, features_dim=observation_space.shape[0])

    def forward(self, scan: torch.Tensor) -> torch.Tensor:
        """Normalise ``[batch, rays]``."""
        return (scan - SCAN_CENTRE) / SCAN_SCALE


class RacecarPolicy(TD3Policy):
    """TD3's policy with an activation of its own for the critics."""

    def __init__(self, *args: Any, critic_activation: type[nn.Module], **kwargs: Any) -> None:
        self._critic_activation = critic_activation
        super().__init__(*args, **kwargs)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Make a critic."""
        self.critic_kwargs["activation_fn"] = self._critic_activation
        return super().make_critic(features_extractor)


@dataclass(frozen=True)
class Trained:
    """What a training left: the controller, how it drives, and its learning curve."""

    controller: Controller
    nominal: Nominal
    curve: list[dict[str, float]]
    record: dict[str, Any]


class _Progress(BaseCallback):
    def __init__(self, report: Callable[[int], None]) -> None:
        super().__init__()
        self._report = report

    def _on_step(self) -> bool:
        if self.num_timesteps % 100 == 0:
            self._report(self.num_timesteps)
        return True


def train(
    setup: Setup,
    seed: int,
    work: Path,
    report: Callable[[int, int], None] = lambda done, total: None,
    timesteps: int | None = None,
) -> Trained:
    """Train one seed of a setup, from its checkpoint in ``work`` if there is one.

    report(done, total) is called as steps are done. timesteps: fewer or more than the
    hyper-parameter file says.
    """
    torch.set_num_threads(1)
    parameters, sha256 = load_hyperparameters(setup.algorithm)
    total = timesteps or parameters.n_timesteps
    work.mkdir(parents=True, exist_ok=True)
    model, curve = _restore(setup, parameters, seed, total, work)
    while model.num_timesteps < total:
        began = time.perf_counter()
        chunk = min(CHUNK, total - model.num_timesteps)
        model.learn(
            chunk,
            callback=_Progress(lambda done: report(done, total)),
            reset_num_timesteps=False,
            log_interval=10**9,
        )
        nominal = drive_nominal(export(model, {}), setup.rays)
        curve.append(
            {
                "timesteps": model.num_timesteps,
                "episode_return": _mean([e["r"] for e in model.ep_info_buffer or ()]),
                "episode_length": _mean([e["l"] for e in model.ep_info_buffer or ()]),
                "nominal_safe_fraction": nominal.safe_fraction,
                "nominal_margin": nominal.margin,
                "seconds": round(time.perf_counter() - began, 1),
            }
        )
        _checkpoint(model, curve, work)
        report(model.num_timesteps, total)
    metadata = {
        "setup": setup.family,
        "algorithm": setup.algorithm,
        "seed": str(seed),
        "timesteps": str(total),
        "hyperparameters_sha256": sha256,
    }
    metadata |= {name: version(name) for name in LIBRARIES}
    controller = export(model, metadata)
    error = export_error(model, controller)
    if not error <= EXPORT_TOLERANCE:
        raise RuntimeError(f"the exported network strays {error} rad from the torch actor")
    nominal = drive_nominal(controller, setup.rays)
    record = metadata | {
        "python": platform.python_version(),
        "hyperparameters": parameters.model_dump(exclude_none=True),
        "export_error_rad": error,
    }
    return Trained(controller, nominal, curve, record)


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def _make_model(setup: Setup, parameters: Hyperparameters, seed: int, total: int) -> TD3:
    env = gymnasium.make(ENVIRONMENT, rays=setup.rays)
    first, falls = parameters.rate()
    arguments = parameters.model_dump(
        exclude_none=True,
        exclude={"n_timesteps", "policy_kwargs", "learning_rate", "action_noise_std"},
    )
    kinds = parameters.policy_kwargs
    model = {"TD3": TD3, "DDPG": DDPG}[setup.algorithm](
        RacecarPolicy,
        env,
        # A function of the steps done: SB3's own progress is relative to one chunk.
        learning_rate=first,
        action_noise=NormalActionNoise(np.zeros(1), np.full(1, parameters.action_noise_std)),
        policy_kwargs={
            "net_arch": {"pi": list(setup.hidden), "qf": kinds.critic},
            "activation_fn": _ACTIVATIONS[kinds.activation],
            "critic_activation": _ACTIVATIONS[kinds.critic_activation],
            "features_extractor_class": NormalisedScan,
        },
        seed=seed,
        device="cpu",
        **arguments,
    )
    if falls:
        model.lr_schedule = lambda _: first * max(0.0, 1 - model.num_timesteps / total)
    return model


_SAVED = ("_last_obs", "_last_episode_starts", "_episode_num", "_n_updates", "num_timesteps")
_STATE = "checkpoint.pt"


def _checkpoint(model: TD3, curve: list[dict[str, float]], work: Path) -> None:
    content = io.BytesIO()
    torch.save(
        {
            "policy": model.policy.state_dict(),
            "optimizers": [model.actor.optimizer.state_dict(), model.critic.optimizer.state_dict()],
            "fields": {name: getattr(model, name, None) for name in _SAVED},
            "episodes": list(model.ep_info_buffer or ()),
            "buffer": model.replay_buffer,
            "env": model.get_env(),
            "random": (random.getstate(), np.random.get_state(), torch.get_rng_state()),
            "spaces": model.action_space,
            "curve": curve,
        },
        content,
    )
    write_whole(work / _STATE, content.getvalue())


def _restore(
    setup: Setup, parameters: Hyperparameters, seed: int, total: int, work: Path
) -> tuple[TD3, list[dict[str, float]]]:
    model = _make_model(setup, parameters, seed, total)
    if not (work / _STATE).exists():
        return model, []
    # Our own file; it holds whole Python objects.
    state = torch.load(work / _STATE, weights_only=False)
    model.policy.load_state_dict(state["policy"])
    model.actor.optimizer.load_state_dict(state["optimizers"][0])
    model.critic.optimizer.load_state_dict(state["optimizers"][1])
    model.set_env(state["env"], force_reset=False)
    model.action_space = state["spaces"]
    model.replay_buffer = state["buffer"]
    for name, value in state["fields"].items():
        setattr(model, name, value)
    model._setup_learn(0, reset_num_timesteps=False)  # makes the episode buffers
    assert model.ep_info_buffer is not None
    model.ep_info_buffer.extend(state["episodes"])
    random.setstate(state["random"][0])
    np.random.set_state(state["random"][1])  # noqa: NPY002 (SB3's generator)
    torch.set_rng_state(state["random"][2])
    return model, state["curve"]


def export(model: TD3, metadata: dict[str, str]) -> Controller:
    """Return the controller of a model's actor."""
    linear = [m for m in model.actor.mu if isinstance(m, nn.Linear)]
    hidden = {nn.Tanh: "tanh", nn.ReLU: "relu"}[type(model.actor.mu[1])]
    kinds = [hidden] * (len(linear) - 1) + ["tanh"]
    layers = [
        (m.weight.detach().numpy(), m.bias.detach().numpy(), kind)
        for m, kind in zip(linear, kinds, strict=True)
    ]
    return fold(layers, metadata)


def export_error(model: TD3, controller: Controller, scans: int = 10_000) -> float:
    """Return the largest difference (rad) between torch actor and controller on random scans."""
    scan = np.random.default_rng(0).uniform(0, 5, (scans, controller.rays)).astype(np.float32)
    with torch.no_grad():
        normalised = model.actor(torch.as_tensor(scan)).numpy()[:, 0].astype(float)
    expected = normalised * racecar.env.MAX_STEERING
    return float(np.abs(controller.steering(scan.astype(float)) - expected).max())


def write_curve(curve: list[dict[str, float]], path: Path) -> None:
    """Write a learning curve as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, curve[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(curve)
    write_whole(path, text.getvalue().encode())


def write_record(record: dict[str, Any], path: Path) -> None:
    """Write a training record as JSON."""
    write_whole(path, (json.dumps(record, indent=2) + "\n").encode())


def forget(work: Path) -> None:
    """Remove the checkpoint of a finished training."""
    shutil.rmtree(work, ignore_errors=True)

"""Training with Stable-Baselines3: seeded, in chunks, resumable after each chunk.

A training that was interrupted and resumed gives the same controller, byte for byte, as one
that was not: a checkpoint holds networks, optimisers, replay buffer, environment and the
state of every random generator.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

import racecar.env
from generator.actor import fold
from generator.checkpoint import restore_checkpoint, save_checkpoint
from generator.hyperparams import ENVIRONMENT, Hyperparameters
from generator.nominal import drive_nominal
from generator.policy import ConvolvedScan, NormalisedScan, RacecarPolicy
from generator.seeds import CHECKPOINT, Trained, training_settings
from generator.setups import Setup
from racecar.controller import Controller
from racecar.layers import Convolution

CHUNK = 5000
_LEARNERS = {"TD3": TD3, "DDPG": DDPG, "EARLY": TD3}
_ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU}
LIBRARIES = ("stable-baselines3", "torch", "gymnasium", "numpy")
#: How far (rad) the exported network may stray from the torch actor: float32 rounding.
EXPORT_TOLERANCE = 1e-5


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
    parameters: Hyperparameters,
    work: Path,
    report: Callable[[int, int], None] = lambda done, total: None,
    chunk: int = CHUNK,
    measure: Callable[[Controller], dict[str, float]] = lambda controller: {},
) -> Trained:
    """Train one seed of a setup, from its checkpoint in ``work`` if there is one.

    report(done, total) is called as steps are done; chunk: steps between checkpoints; measure:
    further columns of the learning curve. Raises BadInput if the checkpoint is broken or was made
    with other settings.
    """
    torch.set_num_threads(1)
    total = parameters.n_timesteps
    libraries = {name: version(name) for name in LIBRARIES}
    settings = training_settings(setup, seed, parameters, libraries)
    model, curve = _make_model(setup, parameters, seed), []
    checkpoint = work / CHECKPOINT
    if checkpoint.exists():
        curve = restore_checkpoint(model, settings, checkpoint)
    while model.num_timesteps < total:
        began = time.perf_counter()
        with _denormals_as_zero():
            model.learn(
                min(chunk, total - model.num_timesteps),
                callback=_Progress(lambda done: report(done, total)),
                reset_num_timesteps=False,
                log_interval=10**9,
            )
        controller = export(model, {})
        nominal = drive_nominal(controller, setup.field_of_view)
        curve.append(
            {
                "timesteps": model.num_timesteps,
                "episode_return": _mean([e["r"] for e in model.ep_info_buffer or ()]),
                "episode_length": _mean([e["l"] for e in model.ep_info_buffer or ()]),
                "nominal_safe_fraction": nominal.safe_fraction,
                "nominal_margin": nominal.margin,
                "seconds": round(time.perf_counter() - began, 1),
            }
            | measure(controller)
        )
        save_checkpoint(model, curve, settings, checkpoint)
        report(model.num_timesteps, total)
    metadata = {
        "setup": setup.family,
        "algorithm": setup.algorithm,
        "seed": str(seed),
        "timesteps": str(total),
        "hyperparameters_sha256": parameters.sha256(),
    }
    controller = export(model, metadata | libraries)
    error = export_error(model, controller)
    if not error <= EXPORT_TOLERANCE:
        raise RuntimeError(f"the exported network strays {error} rad from the torch actor")
    nominal = drive_nominal(controller, setup.field_of_view)
    return Trained(controller, nominal, curve, libraries, error)


@contextmanager
def _denormals_as_zero() -> Iterator[None]:
    """Take denormal numbers for zero.

    Weight decay sends the weights of dead neurons there, and products of matrices then take a
    hundred times longer. It is a state of the whole process, in which the bounds of rounding
    that proofs rely on do not hold: so no longer than need be.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def _make_model(setup: Setup, parameters: Hyperparameters, seed: int) -> TD3:
    more = parameters.env_kwargs.model_dump() if parameters.env_kwargs else {}
    env = gymnasium.make(ENVIRONMENT, rays=setup.rays, field_of_view=setup.field_of_view, **more)
    total = parameters.n_timesteps
    first, falls = parameters.rate()
    arguments = parameters.model_dump(
        exclude_none=True,
        exclude={"env_kwargs", "n_timesteps", "policy_kwargs", "learning_rate", "action_noise_std"},
    )
    kinds = parameters.policy_kwargs
    model = _LEARNERS[setup.algorithm](
        RacecarPolicy,
        env,
        # A function of the steps done: SB3's own progress is relative to one chunk.
        learning_rate=first,
        action_noise=NormalActionNoise(np.zeros(1), np.full(1, parameters.action_noise_std)),
        policy_kwargs={
            "net_arch": {"pi": kinds.hidden or list(setup.hidden), "qf": kinds.critic},
            "convolutions": kinds.convolutions or (),
            "activation_fn": _ACTIVATIONS[kinds.activation],
            "critic_activation": _ACTIVATIONS[kinds.critic_activation],
            "features_extractor_class": NormalisedScan,
            "critic_rays": kinds.critic_rays,
            "optimizer_kwargs": {"weight_decay": kinds.weight_decay or 0.0},
        },
        seed=seed,
        device="cpu",
        **arguments,
    )
    if falls:
        model.lr_schedule = lambda _: first * max(0.0, 1 - model.num_timesteps / total)
    return model


def export(model: TD3, metadata: dict[str, str]) -> Controller:
    """Return the controller of a model's actor."""
    linear = [m for m in model.actor.mu if isinstance(m, nn.Linear)]
    hidden = {nn.Tanh: "tanh", nn.ReLU: "relu"}[type(model.actor.mu[1])]
    convolutions = [(x, hidden) for x in _convolutions(model)]
    kinds = [hidden] * (len(linear) - 1) + ["tanh"]
    layers = [
        (m.weight.detach().numpy(), m.bias.detach().numpy(), kind)
        for m, kind in zip(linear, kinds, strict=True)
    ]
    return fold(layers, metadata, convolutions)


def _convolutions(model: TD3) -> list[Convolution]:
    found: list[Convolution] = []
    scan = model.actor.features_extractor
    if isinstance(scan, ConvolvedScan):
        length = scan.rays
        for m in scan.layers:
            if isinstance(m, nn.Conv1d):
                assert m.bias is not None
                kernels, biases = m.weight.detach().numpy(), m.bias.detach().numpy()
                found.append(Convolution(kernels, biases, m.stride[0], length))
                length = found[-1].places
    return found


def export_error(model: TD3, controller: Controller, scans: int = 10_000) -> float:
    """Return the largest difference (rad) between torch actor and controller on random scans."""
    scan = np.random.default_rng(0).uniform(0, 5, (scans, controller.rays)).astype(np.float32)
    with torch.no_grad():
        normalised = model.actor(torch.as_tensor(scan)).numpy()[:, 0].astype(float)
    expected = normalised * racecar.env.MAX_STEERING
    return float(np.abs(controller.steering(scan.astype(float)) - expected).max())

"""Hyper-parameter files, one per algorithm, a block per environment."""

from __future__ import annotations

import hashlib
from importlib import resources
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from racecar.errors import BadInput

ENVIRONMENT = "racecar/Hallway-v0"
Positive = Annotated[int, Field(gt=0)]


class PolicyArguments(BaseModel):
    """The networks of actor and critic."""

    model_config = ConfigDict(extra="forbid")
    activation: Literal["tanh", "relu"]
    critic: list[Positive]
    critic_activation: Literal["tanh", "relu"]
    weight_decay: Annotated[float, Field(ge=0)] | None = Field(
        None, description="of both optimisers (Adam's L2 term); smaller weights steer more smoothly"
    )


class Hyperparameters(BaseModel):
    """One block of a hyper-parameter file; names are Stable-Baselines3's."""

    model_config = ConfigDict(extra="forbid")
    n_timesteps: Positive
    policy_kwargs: PolicyArguments
    learning_rate: float | str = Field(description="a number, or lin_X: falls linearly from X to 0")
    batch_size: Positive
    buffer_size: Positive
    learning_starts: Positive
    gamma: float
    tau: float
    train_freq: Positive
    gradient_steps: Positive
    action_noise_std: float
    policy_delay: Positive | None = None
    target_policy_noise: float | None = None
    target_noise_clip: float | None = None

    def rate(self) -> tuple[float, bool]:
        """Return the first learning rate and whether it falls linearly to 0."""
        text = str(self.learning_rate)
        try:
            return float(text.removeprefix("lin_")), text.startswith("lin_")
        except ValueError:
            raise BadInput(f"learning_rate {text!r}: write a number or lin_ and a number") from None

    def sha256(self) -> str:
        """Return a hash of the values, however the file that they came from is laid out."""
        return hashlib.sha256(self.model_dump_json(exclude_none=True).encode()).hexdigest()


def load_hyperparameters(algorithm: str) -> Hyperparameters:
    """Return an algorithm's hyper-parameters."""
    file = resources.files(__name__) / f"{algorithm.lower()}.yml"
    try:
        block = yaml.safe_load(file.read_bytes())[ENVIRONMENT]
        return Hyperparameters.model_validate(block)
    except (yaml.YAMLError, KeyError, ValidationError) as error:
        raise BadInput(f"{file}: not a hyper-parameter file for {ENVIRONMENT}: {error}") from None

"""Hyper-parameter files, one per algorithm, a block per environment."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import Field, ValidationError

from generator.hyperparams.base import Arguments, Positive
from generator.hyperparams.robust import STUDENTS, RobustHyperparameters
from racecar.errors import BadInput

ENVIRONMENT = "racecar/Hallway-v0"


class ConvolutionArguments(Arguments):
    """One convolution along the scan, without padding."""

    channels: Positive
    kernel: Positive = Field(description="places that a window covers")
    stride: Positive


class PolicyArguments(Arguments):
    """The networks of actor and critic."""

    activation: Literal["tanh", "relu"]
    critic: list[Positive]
    critic_activation: Literal["tanh", "relu"]
    critic_rays: Annotated[int, Field(ge=2)] | None = Field(
        None, description="the critics read every k-th ray, for the largest k that leaves so many"
    )
    convolutions: list[ConvolutionArguments] | None = Field(
        None, min_length=1, description="of the actor, the first next to the scan"
    )
    hidden: list[Positive] | None = Field(
        None, description="neurons of the actor's layers behind the convolutions"
    )
    weight_decay: Annotated[float, Field(ge=0)] | None = Field(
        None, description="of both optimisers (Adam's L2 term); smaller weights steer more smoothly"
    )


class EnvironmentArguments(Arguments):
    """Arguments of the training's environment."""

    faults: str = Field(description="a name that the environment knows, such as paper")


class Hyperparameters(Arguments):
    """One block of a hyper-parameter file; names are Stable-Baselines3's and rl-zoo3's."""

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
    env_kwargs: EnvironmentArguments | None = None

    def rate(self) -> tuple[float, bool]:
        """Return the first learning rate and whether it falls linearly to 0."""
        text = str(self.learning_rate)
        try:
            return float(text.removeprefix("lin_")), text.startswith("lin_")
        except ValueError:
            raise BadInput(f"learning_rate {text!r}: write a number or lin_ and a number") from None


AnyHyperparameters = Hyperparameters | RobustHyperparameters


def load_hyperparameters(name: str, own: Path | None = None) -> AnyHyperparameters:
    """Return hyper-parameters, from the package or a file of one's own.

    name: of the file, such as TD3 or TD3_wide_scan. BadInput if the package has none of this
    name, or if the file is not one for the algorithm.
    """
    kind = RobustHyperparameters if name in STUDENTS else Hyperparameters
    file = own or resources.files(__name__) / f"{name.lower()}.yml"
    if not file.is_file():
        raise BadInput(
            f"hyper-parameters {file.name} do not exist; write a file and give it with "
            "--hyperparameters"
        )
    try:
        block = yaml.safe_load(file.read_bytes())[ENVIRONMENT]
        return kind.model_validate(block)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(x) for x in first["loc"])
        raise BadInput(f"{file}: {place}: {first['msg']}") from None
    except (yaml.YAMLError, KeyError, TypeError):
        raise BadInput(f"{file}: not a hyper-parameter file with a block {ENVIRONMENT}") from None

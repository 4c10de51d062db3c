"""The hyper-parameters of robust training; ``robust.yml`` says why they are what they are."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from generator.hyperparams.base import Arguments, Positive

#: Families that learn from a teacher: for many missing rays, and for proofs under noise.
STUDENTS = ("ROBUST", "SMOOTH")

Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class TeacherArguments(Arguments):
    """The teacher's line and how far ahead it aims, metres."""

    lane: Length
    radius: Length
    look_turn: Length
    look_straight: Length


class FaultArguments(Arguments):
    """What goes wrong with scans in training.

    missing: so many ray indices at most are drawn (with replacement) for a drive, missing in
    the turn; all_missing: share of the drives with so many, in the others it is any number up
    to it; noise: one-sided, metres; noise_levels: shares of it; jitter: two-sided, metres;
    curriculum_rounds: over which all of this grows from nothing; mined: share of the drives
    whose missing rays are those with the least margin now.
    """

    missing: Count
    all_missing: Share
    noise: NotNegative
    noise_levels: list[Share] = Field(min_length=1)
    jitter: NotNegative
    curriculum_rounds: Count = 0
    mined: Share = 0.0


class RobustHyperparameters(Arguments):
    """One block of the hyper-parameter file of ROBUST or SMOOTH."""

    rounds: Positive
    cars: Positive
    steps: Positive
    kept_rounds: Positive
    teacher_rounds: Count
    near_turn: Share
    teacher: TeacherArguments
    faults: FaultArguments
    gradient_steps: Positive
    batch_size: Positive
    learning_rate: Length
    weight_decay: NotNegative
    gain_penalty: NotNegative

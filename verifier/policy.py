"""When a row is accepted after a step, and when it is split or given up."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Policy:
    """When a row is accepted.

    coarsest: a row whose errors (m, rad) exceed this is given up; growth: the share of the
    errors that a row comes with by which they may grow in a step; futile: if splitting did not
    bring the error of a step below this share, it is accepted; bearable: the same where
    splitting does not help; kink: the share of them (per metre) up to which kinks are kept in the
    radius; gain: how much larger than a kink (1/m) the error of a step that keeps it may be;
    kinked: the share of the errors that a row comes with which that may be at most; push: the share
    of what noise does in a step by which the errors may grow; slack: what a step adds to the errors
    is taken this much larger, so that a checker whose own bounds are a little wider finds room.
    """

    coarsest: float
    futile: float
    growth: float
    bearable: float
    kink: float
    gain: float
    kinked: float
    push: float
    slack: float


#: One uncertain number: errors are small beside what x does.
NARROW = Policy(
    coarsest=2e-3,
    futile=0.5,
    growth=0.1,
    bearable=np.inf,
    kink=0.0,
    gain=100.0,
    kinked=np.inf,
    push=0.0,
    slack=1.25,
)
#: Several: errors are what there is.
WIDE = Policy(
    coarsest=0.1,
    futile=0.85,
    growth=0.01,
    bearable=1.0,
    kink=0.1,
    gain=100.0,
    kinked=1.5,
    push=0.2,
    slack=1.5,
)
#: The same where what the noise does is larger than what dividing rows could save.
BOLD = replace(WIDE, growth=0.05, push=0.5)

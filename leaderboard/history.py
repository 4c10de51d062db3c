"""The paper's tables, as printed: history to stand beside new results, never ranked.

Source: R. Ivanov, T. J. Carpenter, J. Weimer, R. Alur, G. J. Pappas, I. Lee: "Case study: verifying
the safety of an autonomous racing car with a neural network controller", HSCC 2020,
doi:10.1145/3365365.3382216, Tables 1 and 2.
"""

from __future__ import annotations

from dataclasses import dataclass

from verifier.paper_table1 import PAPER, PaperRow


@dataclass(frozen=True)
class Setup:
    """A controller's name taken apart."""

    algorithm: str
    rays: int
    layers: str
    index: int


@dataclass(frozen=True)
class Driven:
    """Outcomes of ten real runs of 7 s each: how many were safe.

    modified: with most reflecting surfaces covered; unmodified: as the building is.
    """

    modified: int
    unmodified: int


#: Table 2, by the controller's name.
TABLE2 = {
    "DDPG_L21_64x64_C1": Driven(9, 0),
    "DDPG_L21_64x64_C2": Driven(9, 2),
    "DDPG_L21_64x64_C3": Driven(10, 8),
    "DDPG_L21_128x128_C1": Driven(10, 8),
    "DDPG_L21_128x128_C2": Driven(7, 4),
    "DDPG_L21_128x128_C3": Driven(9, 0),
    "TD3_L21_64x64_C1": Driven(8, 9),
    "TD3_L21_64x64_C2": Driven(10, 9),
    "TD3_L21_64x64_C3": Driven(10, 9),
    "TD3_L21_128x128_C1": Driven(9, 9),
    "TD3_L21_128x128_C2": Driven(9, 9),
    "TD3_L21_128x128_C3": Driven(9, 9),
}


def setup(name: str) -> Setup:
    """Take a controller's name apart, e.g. ``TD3_L41_64x64_C1``."""
    algorithm, rays, layers, index = name.split("_")
    return Setup(algorithm, int(rays[1:]), layers, int(index[1:]))


def table1() -> list[tuple[Setup, PaperRow]]:
    """Return Table 1 in the paper's order."""
    return [(setup(name), row) for name, row in PAPER.items()]


def table2() -> list[tuple[Setup, Driven]]:
    """Return Table 2 in the paper's order."""
    return [(setup(name), row) for name, row in TABLE2.items()]

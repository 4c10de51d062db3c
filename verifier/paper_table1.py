"""The paper's Table 1, as printed: history to stand beside new results.

Source: R. Ivanov, T. J. Carpenter, J. Weimer, R. Alur, G. J. Pappas, I. Lee: "Case study:
verifying the safety of an autonomous racing car with a neural network controller", HSCC 2020,
doi:10.1145/3365365.3382216, Table 1 and its caption.
"""

from __future__ import annotations

from dataclasses import dataclass

VERIFIED, DNF, CRASH = "verified", "DNF", "Verisig/Flow* crash"
#: The starred row: 2 of its 100 subsets were killed after 24 hours.
PARTLY = "98 of 100 subsets verified"


@dataclass(frozen=True)
class PaperRow:
    """One setup. Times and paths are means over the subsets, each on one core (1.2 GHz).

    outcome: VERIFIED; PARTLY; DNF (terminated after 10 hours on 1 mm subsets); or CRASH.
    width: of the subsets, metres; mean_network_time_s, mean_time_s: seconds; mean_paths: paths
    through the hybrid model of the LiDAR. All None where the verification did not succeed.
    """

    outcome: str
    width: float | None = None
    mean_network_time_s: float | None = None
    mean_time_s: float | None = None
    mean_paths: float | None = None


_5MM, _2MM = 0.005, 0.002

#: By the controller's name: algorithm, LiDAR rays, hidden layers, controller index.
PAPER = {
    "DDPG_L21_64x64_C1": PaperRow(VERIFIED, _2MM, 355, 4126, 1.32),
    "DDPG_L21_64x64_C2": PaperRow(VERIFIED, _2MM, 347, 4122, 1.15),
    "DDPG_L21_64x64_C3": PaperRow(DNF),
    "DDPG_L21_128x128_C1": PaperRow(DNF),
    "DDPG_L21_128x128_C2": PaperRow(DNF),
    "DDPG_L21_128x128_C3": PaperRow(DNF),
    "TD3_L21_64x64_C1": PaperRow(VERIFIED, _5MM, 553, 4731, 2.2),
    "TD3_L21_64x64_C2": PaperRow(VERIFIED, _5MM, 853, 8094, 2.825),
    "TD3_L21_64x64_C3": PaperRow(VERIFIED, _5MM, 724, 8641, 2.725),
    "TD3_L21_128x128_C1": PaperRow(VERIFIED, _5MM, 197, 3760, 1.6),
    "TD3_L21_128x128_C2": PaperRow(VERIFIED, _5MM, 355, 5954, 1.775),
    "TD3_L21_128x128_C3": PaperRow(CRASH),
    "TD3_L41_64x64_C1": PaperRow(PARTLY, _2MM, 634, 11915, 2.194),
    "TD3_L41_128x128_C1": PaperRow(DNF),
    "TD3_L61_64x64_C1": PaperRow(DNF),
    "TD3_L61_128x128_C1": PaperRow(DNF),
}

#: How the rows are to be read.
NOTE = (
    "paper: Table 1 of Ivanov et al., HSCC 2020, for the setup of the same name (the paper's "
    "own network; a new one may share its name): mean per subset, one core at 1.2 GHz. DNF: "
    "terminated after 10 hours on 1 mm subsets. These pioneering figures are shown as history, "
    "not as ground truth: the prototype's script wrote the unsafe set as four blocks for one "
    "mode, of which Flow* takes only the last (y2 <= 0.3), and its enclosure of arctan was not "
    "sound (that of its successor, Verisig 2.0, is)."
)

"""A fault model from what a person wrote: a name, or a file."""

from __future__ import annotations

from pathlib import Path

from racecar.errors import BadInput
from racecar.faultmodels.named import fault_names, named_faults
from racecar.faultmodels.spec import FaultSpec, load_faults
from racecar.faults import FAULTS, Faults


def find_faults(given: str) -> Faults | FaultSpec:
    """Return the faults of a name, or of a JSON file if the text ends so; else BadInput."""
    if given in FAULTS:
        return FAULTS[given]
    if given in fault_names():
        return named_faults(given)
    if given.endswith(".json"):
        return load_faults(Path(given))
    names = ", ".join([*FAULTS, *fault_names()])
    raise BadInput(f"faults {given!r} are unknown; choose from {names}, or give a .json file")

"""The fault models that the package brings along, one JSON file each."""

from __future__ import annotations

from functools import cache
from importlib import resources

from racecar.errors import BadInput
from racecar.faultmodels.spec import FaultSpec, parse_faults

_FOLDER = "named"


@cache
def fault_names() -> tuple[str, ...]:
    """Return the names of the models, sorted."""
    files = resources.files(__package__).joinpath(_FOLDER).iterdir()
    return tuple(sorted(x.name.removesuffix(".json") for x in files if x.name.endswith(".json")))


@cache
def named_faults(name: str) -> FaultSpec:
    """Return the model of that name; BadInput if there is none."""
    if name not in fault_names():
        raise BadInput(f"faults {name!r} are unknown; choose from {', '.join(fault_names())}")
    file = resources.files(__package__).joinpath(_FOLDER, f"{name}.json")
    return parse_faults(file.read_bytes(), str(file))

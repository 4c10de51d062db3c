"""The text of the data card."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jinja2

from generator.card.claims import claims
from generator.card.facts import CategoryFacts, Dataset
from generator.categories import CATEGORIES
from generator.controllers_table import Row
from generator.hybrid.part import Packing
from generator.instances import ControllerFile
from racecar.instance import read_text

_HERE = Path(__file__).parent
#: Where the documentation shows how an instance is read with json and onnxruntime alone.
READING = "docs/categories.md", "## Reading an instance without this package\n"


@dataclass(frozen=True)
class _Tally:
    """What is known about a category, ready to be printed."""

    name: str
    sat: int
    unsat: int
    unknown: int
    untried: int
    proved: str
    found: str
    seconds: str


def card_text(root: Path, dataset: Dataset, figures: Sequence[str]) -> str:
    """Return benchmarks/README.md; figures: names of the files there are."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    counts = {
        category.name: Counter(asked.controller for asked in category.instances)
        for category in dataset.categories
    }
    return environment.get_template("README.md.jinja").render(
        dataset=dataset,
        total=sum(len(category.instances) for category in dataset.categories),
        version=version("closedlap"),
        formats={category.name: _formats(category.name) for category in dataset.categories},
        timeouts={category.name: _timeouts(category) for category in dataset.categories},
        controllers=[
            _controller(file, row)
            for file, row in zip(dataset.controllers, dataset.table, strict=True)
        ],
        drives=_drives(dataset.table),
        counts=counts,
        tallies=[_tally(category) for category in dataset.categories if category.results],
        unknown=[category.name for category in dataset.categories if not category.results],
        claims=claims(dataset),
        figures=figures,
        reading=_reading(root),
    )


def _formats(name: str) -> str:
    category = CATEGORIES.get(name)
    if category is None:
        return ""
    if category.make:
        return "VNN-LIB 1.0 and 2.0"
    hybrid = "" if category.packing is Packing.NONE else ", Flow*, SpaceEx, Verisig"
    return f"JSON{hybrid}"


def _timeouts(category: CategoryFacts) -> str:
    seconds = sorted({asked.timeout for asked in category.instances})
    return f"{seconds[0]}" if len(seconds) == 1 else f"{seconds[0]} to {seconds[-1]}"


def _drives(table: Sequence[Row]) -> str:
    """Return how many runs under the paper's faults are behind a row of the table."""
    counts = sorted({row.paper_runs for row in table})
    return " or ".join(f"{count:,}" for count in counts)


def _controller(file: ControllerFile, row: Row) -> dict[str, Any]:
    low, high = row.paper_safe_interval
    return {
        "name": file.name,
        "rays": row.rays,
        "network": _network(file),
        "parameters": file.parameters,
        "seeds": row.seeds(),
        "reward": "" if row.training_return is None else f"{row.training_return:.0f}",
        "minutes": f"{row.minutes:.0f}",
        "margin": f"{row.nominal_margin:.4f}",
        "smoothness": f"{1000 * row.smoothness:.1f}",
        "safe": f"{100 * row.paper_safe_fraction:.2f} ({100 * low:.2f} to {100 * high:.2f})",
    }


def _network(file: ControllerFile) -> str:
    """Return its hidden layers, such as ``64x64 tanh`` or ``conv 4, conv 8, 64 tanh``."""
    hidden = [layer for layer in file.controller.layers if len(layer.biases) > 1]
    convolved = [x.convolution for x in hidden if x.convolution is not None]
    dense = "x".join(str(len(x.biases)) for x in hidden if x.convolution is None)
    parts = [*(f"conv {len(x.biases)}" for x in convolved), *([dense] if dense else [])]
    names = {"relu": "ReLU"}
    activations = dict.fromkeys(names.get(x.activation, x.activation) for x in hidden)
    return f"{', '.join(parts)} {'/'.join(activations)}"


def _tally(category: CategoryFacts) -> _Tally:
    in_metres = category.name not in CATEGORIES or CATEGORIES[category.name].make is None
    results = category.results if in_metres else []
    proved = [x.lower for x in results if x.verdict == "unsat" and x.lower is not None]
    found = [x.upper for x in results if x.verdict == "sat" and x.upper is not None]
    times = [x.seconds for x in category.results if x.decided and x.seconds is not None]
    return _Tally(
        category.name,
        category.count("sat"),
        category.count("unsat"),
        category.count("unknown"),
        len(category.instances) - len(category.results),
        _range(proved),
        _range(found),
        f"{_seconds(statistics.median(times))} / {_seconds(max(times))}" if times else "",
    )


def _range(margins: Sequence[float]) -> str:
    return f"{_metres(min(margins))} to {_metres(max(margins))}" if margins else ""


def _metres(margin: float) -> str:
    """Return a margin with four decimals, or with one digit where these would be zeros."""
    return f"{margin:.4f}" if abs(margin) >= 0.00005 else f"{margin:.0e}"


def _seconds(time: float) -> str:
    return f"{time:.0f}" if time >= 10 else f"{time:.1f}"


def _reading(root: Path) -> str:
    """Return the program of the documentation that reads an instance; nothing without it."""
    path, heading = root / READING[0], READING[1]
    if not path.exists():
        return ""
    section = read_text(path).decode().partition(heading)[2].partition("\n##")[0]
    return "\n".join(line[4:] for line in section.splitlines() if line.startswith("    "))

"""The table of the trained controllers: their seeds, and how they drive with faults and without.

A row is what the record and the learning curve of a controller say, and runs under the paper's
faults, which are the same for each controller of as many rays.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from generator.instances import benchmark_plant
from generator.published import load_published, published_names
from generator.record import Tried
from generator.setups import parse_setup
from racecar.errors import BadInput
from racecar.experiment import Experiment, RandomStarts, run_experiment
from racecar.faults import FAULTS
from racecar.instance import read_text
from racecar.safety import named_property
from racecar.summary import wilson_interval

#: Runs under the paper's faults behind each row, and the seed that draws them.
RUNS, SEED = 20_000, 0


@dataclass(frozen=True)
class Row:
    """A controller.

    tried: the seeds up to its own; steps: of the environment, None if it learned from a teacher;
    training_return: mean of the last 100 episodes of the training, None likewise; minutes:
    that the training took; nominal_margin (m), smoothness (mean absolute change of the steering
    from step to step, rad), label: generator.nominal; paper_safe: of ``paper_runs`` runs under
    the paper's faults, as the paper judges, with its share's 95 % Wilson interval.
    """

    name: str
    setup: str
    rays: int
    network: str
    seed: int
    tried: tuple[Tried, ...]
    steps: int | None
    training_return: float | None
    minutes: float
    nominal_margin: float
    smoothness: float
    label: str
    paper_runs: int
    paper_safe: int
    paper_safe_fraction: float
    paper_safe_interval: tuple[float, float]

    def flat(self) -> dict[str, str | int | float | None]:
        """Return it as cells of a table; seeds that finished the turn are named apart."""
        cells = asdict(self)
        cells["tried"] = " ".join(str(x.seed) for x in self.tried)
        finished = " ".join(str(x.seed) for x in self.tried if x.finishes_turn)
        low, high = cells.pop("paper_safe_interval")
        return cells | {"finished": finished, "paper_safe_low": low, "paper_safe_high": high}


def table_row(root: Path, name: str, runs: int = RUNS) -> Row:
    """Return the row of the controller NAME in ROOT/onnx.

    Raises BadInput if one of its three files is missing or broken, or the network is not the one
    of the record.
    """
    file, record = load_published(root, name)
    setup, curve = parse_setup(name), _read_curve(file.path.with_suffix(".curve.csv"))
    plant = benchmark_plant(setup.rays, setup.field_of_view)
    safety = named_property("clearance", plant.track)
    experiment = Experiment(plant, safety, RandomStarts(), FAULTS["paper"], runs, seed=SEED)
    safe = int(run_experiment(experiment, file.controller.steering_rows).safe.sum())
    last = curve[-1]
    return Row(
        name=name,
        setup=record.setup,
        rays=setup.rays,
        network=setup.network,
        seed=record.seed,
        tried=tuple(record.tried),
        steps=int(last["timesteps"]) if "timesteps" in last else None,
        training_return=last.get("episode_return"),
        minutes=round(sum(row["seconds"] for row in curve) / 60, 1),
        nominal_margin=record.nominal.margin,
        smoothness=record.nominal.smoothness,
        label=record.label,
        paper_runs=runs,
        paper_safe=safe,
        paper_safe_fraction=safe / runs,
        paper_safe_interval=wilson_interval(safe, runs),
    )


def trained_names(root: Path) -> list[str]:
    """Return the names of the controllers in ROOT/onnx that have a record: by setup.

    Raises BadInput if there is none.
    """
    setups = sorted(
        map(parse_setup, published_names(root)),
        key=lambda x: (x.algorithm, x.rays, x.activation != "tanh", x.hidden, x.index),
    )
    return [x.name for x in setups]


def format_table(rows: Sequence[Row]) -> str:
    """Return rows as CSV text."""
    text = io.StringIO()
    cells = [row.flat() for row in rows]
    writer = csv.DictWriter(text, cells[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(cells)
    return text.getvalue()


def _read_curve(path: Path) -> list[dict[str, float]]:
    try:
        reader = csv.DictReader(io.StringIO(read_text(path).decode()))
        rows = [{key: float(value) for key, value in row.items()} for row in reader]
        if not rows or "seconds" not in rows[0]:
            raise ValueError
    except (ValueError, TypeError):
        raise BadInput(f"{path}: not a learning curve; train the controller again") from None
    return rows

"""The table of the trained controllers: their seeds, and how they drive with faults and without.

A row is what the record and the learning curve of a controller say, and runs under the paper's
faults, which are the same for each controller of as many rays. The runs take minutes, all else
nothing: from a table that is there only the counts of runs are read, and all else is made anew.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path

from generator.instances import ControllerFile, benchmark_plant
from generator.piece import FOLDER
from generator.published import load_published, published_names
from generator.record import ControllerRecord, Tried
from generator.setups import parse_setup
from racecar.errors import BadInput
from racecar.experiment import Experiment, RandomStarts, run_experiment
from racecar.faults import FAULTS
from racecar.instance import read_text
from racecar.safety import named_property
from racecar.summary import wilson_interval

#: Where the table lies, and the command that brings it up to date.
TABLE, COMMAND = f"{FOLDER}/controllers.csv", "generator controllers --write"
#: Runs under the paper's faults behind each row, and the seed that draws them.
RUNS, SEED = 20_000, 0


@dataclass(frozen=True)
class Runs:
    """How many runs under the paper's faults there were, and how many of them were safe."""

    count: int
    safe: int


#: A controller and its record.
Published = tuple[ControllerFile, ControllerRecord]
#: Counts of runs by the sha256 of the network that drove.
Measured = dict[str, Runs]


@dataclass(frozen=True)
class Row:
    """A controller.

    sha256: of the ONNX file; tried: the seeds up to its own; steps: of the environment, None if
    it learned from a teacher; training_return: mean of the last 100 episodes of the training,
    None likewise; minutes: that the training took; nominal_margin (m), smoothness (mean absolute
    change of the steering from step to step, rad), label: generator.nominal; paper_safe: of
    ``paper_runs`` runs under the paper's faults, as the paper judges, with its share's 95 %
    Wilson interval.
    """

    name: str
    sha256: str
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

    def seeds(self) -> str:
        """Return the seeds tried, those in brackets that did not finish the turn."""
        return " ".join(str(x.seed) if x.finishes_turn else f"({x.seed})" for x in self.tried)


def trained_names(root: Path) -> list[str]:
    """Return the names of the controllers in ROOT/onnx that have a record: by setup.

    Raises BadInput if there is none.
    """
    setups = sorted(
        map(parse_setup, published_names(root)),
        key=lambda x: (x.algorithm, x.rays, x.activation != "tanh", x.hidden, x.index),
    )
    return [x.name for x in setups]


def drive(
    file: ControllerFile, runs: int = RUNS, report: Callable[[int, int], None] | None = None
) -> Runs:
    """Simulate a controller under the paper's faults; report(done, runs) counts."""
    done = 0

    def count(block: int) -> None:
        nonlocal done
        done += block
        if report is not None:
            report(done, runs)

    setup = parse_setup(file.name)
    plant = benchmark_plant(setup.rays, setup.field_of_view)
    safety = named_property("clearance", plant.track)
    experiment = Experiment(plant, safety, RandomStarts(), FAULTS["paper"], runs, seed=SEED)
    outcome = run_experiment(experiment, file.controller.steering_rows, progress=count)
    return Runs(runs, int(outcome.safe.sum()))


def make_row(file: ControllerFile, record: ControllerRecord, runs: Runs) -> Row:
    """Return the row of a controller; BadInput if its learning curve is missing or broken."""
    setup, curve = parse_setup(file.name), _read_curve(file.path.with_suffix(".curve.csv"))
    last = curve[-1]
    return Row(
        name=file.name,
        sha256=file.sha256,
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
        paper_runs=runs.count,
        paper_safe=runs.safe,
        paper_safe_fraction=runs.safe / runs.count,
        paper_safe_interval=wilson_interval(runs.safe, runs.count),
    )


def load_all(root: Path) -> list[Published]:
    """Return the controllers in ROOT/onnx and their records, by setup.

    Raises BadInput if there is none, or one of them is broken.
    """
    return [load_published(root, name) for name in trained_names(root)]


def known_rows(published: Iterable[Published], measured: Mapping[str, Runs]) -> list[Row]:
    """Return the rows of the controllers whose runs were counted."""
    return [
        make_row(file, record, measured[file.sha256])
        for file, record in published
        if file.sha256 in measured
    ]


def format_table(rows: Sequence[Row]) -> bytes:
    """Return rows as a CSV file."""
    text = io.StringIO()
    cells = [row.flat() for row in rows]
    writer = csv.DictWriter(text, cells[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(cells)
    return text.getvalue().encode()


def read_measured(root: Path) -> Measured:
    """Return the counts of runs that ROOT's table has; none without a table.

    Raises BadInput if it is broken.
    """
    return dict(_read(root / TABLE).values())


def read_table(root: Path, published: Sequence[Published]) -> list[Row]:
    """Return ROOT's table.

    Raises BadInput if it is missing or broken, or is not the one of these controllers.
    """
    path = root / TABLE
    there = _read(path)
    for file, _ in published:
        sha256, _ = there.get(file.name, ("", None))
        if sha256 != file.sha256:
            wrong = "the row of {} is of another network" if sha256 else "there is no row of {}"
            raise BadInput(f"{path}: {wrong.format(file.name)}; run `{COMMAND}`")
    rows = known_rows(published, dict(there.values()))
    pairs = zip_longest(read_text(path).splitlines(), format_table(rows).splitlines())
    for number, (line, expected) in enumerate(pairs, 1):
        if line != expected:
            raise BadInput(
                f"{path}, line {number}: not what records and learning curves say; run `{COMMAND}`"
            )
    return rows


def _read(path: Path) -> dict[str, tuple[str, Runs]]:
    """Return what a table says of each controller's network and of its runs, by name."""
    if not path.exists():
        return {}
    found = {}
    rows = csv.DictReader(io.StringIO(read_text(path).decode(errors="replace")), strict=True)
    try:
        for row in rows:
            runs = Runs(int(row["paper_runs"]), int(row["paper_safe"]))
            if not 0 <= runs.safe <= runs.count > 0:
                raise ValueError
            found[row["name"]] = row["sha256"], runs
    except (KeyError, ValueError, TypeError, csv.Error):
        raise BadInput(
            f"{path}, line {rows.line_num}: no row of the table; restore the file, or remove it "
            f"and run `{COMMAND}`"
        ) from None
    return found


def _read_curve(path: Path) -> list[dict[str, float]]:
    try:
        reader = csv.DictReader(io.StringIO(read_text(path).decode()))
        rows = [{key: float(value) for key, value in row.items()} for row in reader]
        if not rows or "seconds" not in rows[0]:
            raise ValueError
    except (ValueError, TypeError):
        raise BadInput(f"{path}: not a learning curve; train the controller again") from None
    return rows

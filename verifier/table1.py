"""The paper's Table 1 for any controllers: which subset width decides the whole start range.

As in the paper the start range (20 cm) is tried with smaller and smaller subsets until all
subsets of one width are decided; here the first of them is the whole range at once. Each
controller is treated on one core.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from decimal import Decimal
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.controller import RuntimeSteer, load_controller
from racecar.errors import BadInput
from racecar.experiment import STEPS, default_field_of_view
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import square_track
from verifier.paper_table1 import PAPER, PaperRow
from verifier.problem import Problem
from verifier.result import Result
from verifier.rows import F, S
from verifier.verify import verify

#: The start range of s and the start's f (m), as decimals, so that subsets tile the range exactly.
LOWER, UPPER, FRONT = Decimal("0.65"), Decimal("0.85"), 9.9
#: Subset widths (m) to try, in turn: the whole range, then the paper's.
WIDTHS = tuple(map(Decimal, ("0.2", "0.005", "0.002", "0.001")))
#: More subsets than this width gives (20,000) are of no use.
NARROWEST = Decimal("0.00001")

#: Told of progress: the controller's name, the width (m) that is tried, the share that is done.
Report = Callable[[str, float, float], None]


@dataclass(frozen=True)
class Attempt:
    """What came of one subset width.

    width: metres; subsets: how many the range has; the rest as in verifier.result.Result, summed
    over the subsets. A width is left at its first undecided or unsafe subset: those after it
    count as undecided.
    """

    width: float
    subsets: int
    verdict: str
    decided: float
    network_time_s: float
    time_s: float
    paths: int
    leaves: int
    margin_lower: float | None
    margin_upper: float | None


@dataclass(frozen=True)
class Table1Row:
    """One controller: the first attempt that decides the range, else the one that got furthest.

    width: of the subsets needed (m), None if no width sufficed; tried: all attempts, in turn;
    paper: what the paper reports of the setup of this name.
    """

    controller: str
    onnx: str
    safety: str
    best: Attempt
    tried: tuple[Attempt, ...]
    paper: PaperRow | None

    @property
    def width(self) -> float | None:
        """The subset width needed (m); None if the range is not decided."""
        return None if self.best.verdict == "unknown" else self.best.width

    def to_json(self) -> dict[str, Any]:
        """Return the row as plain data."""
        figures = asdict(self.best)
        return {
            "controller": self.controller,
            "verdict": figures.pop("verdict"),
            "decided": figures.pop("decided"),
            **figures,
            "width": self.width,
            "property": self.safety,
            "onnx": self.onnx,
            "tried": [
                {"width": a.width, "decided": a.decided, "time_s": a.time_s} for a in self.tried
            ],
            "paper": None if self.paper is None else asdict(self.paper),
        }


@dataclass(frozen=True)
class Settings:
    """How a table is made.

    widths: metres, tried in this order; safety: name of the property; timeout: seconds for each
    controller and width; field_of_view: radians, None for the paper's; steps: control periods.
    """

    widths: tuple[Decimal, ...] = WIDTHS
    safety: str = "clearance"
    timeout: float = 300.0
    field_of_view: float | None = None
    steps: int = STEPS


def subset_width(text: str) -> Decimal:
    """Read a subset width (m); BadInput unless the range is a whole number of such subsets."""
    try:
        width = Decimal(text)
    except ArithmeticError:
        raise BadInput(f"width {text!r} is not a decimal number") from None
    if not width.is_finite() or width < NARROWEST or (UPPER - LOWER) % width:
        raise BadInput(
            f"width {text}: subsets are to tile the start range of {UPPER - LOWER} m; "
            f"give metres, at least {NARROWEST}, that divide it"
        )
    return width


def subsets(width: Decimal) -> list[tuple[float, float]]:
    """Return the bounds of the subsets; neighbours share the same double."""
    count = int((UPPER - LOWER) / width)
    return list(pairwise(float(LOWER + i * width) for i in range(count + 1)))


def table(
    files: list[Path], settings: Settings, jobs: int = 1, report: Report = lambda *_: None
) -> Iterator[Table1Row]:
    """Yield a row per controller file, in their order; ``jobs`` controllers at the same time.

    report is only called with one job. Raises BadInput for a bad file before anything is proved.
    """
    for file in files:
        load_controller(file)
    if jobs == 1 or len(files) == 1:
        for file in files:
            yield make_row(file, settings, report)
        return
    # Fresh interpreters: onnxruntime's threads do not survive a fork.
    pool = ProcessPoolExecutor(min(jobs, len(files)), mp_context=get_context("spawn"))
    try:
        yield from pool.map(partial(make_row, settings=settings), files)
    finally:
        pool.shutdown(cancel_futures=True)


def make_row(file: Path, settings: Settings, report: Report = lambda *_: None) -> Table1Row:
    """Decide the start range of one controller."""
    problem, steer, tried = whole_range(file, settings), RuntimeSteer(file), []
    for width in settings.widths:
        tell = partial(report, file.stem, float(width))
        tried.append(attempt(problem, steer, width, settings.timeout, tell))
        if tried[-1].verdict != "unknown":
            break
    decided = [a for a in tried if a.verdict != "unknown"]
    best = decided[0] if decided else max(tried, key=lambda a: a.decided)
    return Table1Row(
        file.stem, str(file), settings.safety, best, tuple(tried), PAPER.get(file.stem)
    )


def whole_range(file: Path, settings: Settings) -> Problem:
    """Return the question about the whole start range of a controller, on the paper's track."""
    controller, track, view = load_controller(file), square_track(), settings.field_of_view
    if view is None:
        view = default_field_of_view(controller.rays)
    lower, upper = np.zeros(4), np.zeros(4)
    lower[S], upper[S] = float(LOWER), float(UPPER)
    lower[F] = upper[F] = FRONT
    plant = Plant(track, Bicycle(), Lidar(controller.rays, view))
    safety = named_property(settings.safety, track)
    return Problem(plant, controller, safety, settings.steps, lower, upper)


def attempt(
    problem: Problem,
    steer: RuntimeSteer,
    width: Decimal,
    timeout: float,
    report: Callable[[float], None] = lambda share: None,
) -> Attempt:
    """Verify the subsets of one width, one after the other, until one is not proved safe.

    timeout: seconds for all of them together; report(share done).
    """
    parts, results = subsets(width), list[Result]()
    began = time.monotonic()
    for i, (low, high) in enumerate(parts):
        left = began + timeout - time.monotonic()
        if left <= 0:
            break
        lower, upper = problem.lower.copy(), problem.upper.copy()
        lower[S], upper[S] = low, high
        results.append(
            verify(
                replace(problem, lower=lower, upper=upper), steer, left,
                lambda share: report((i + share) / len(parts)),  # noqa: B023 (called at once)
            )
        )  # fmt: skip
        if results[-1].verdict != "unsat":
            break
    return _summed(float(width), len(parts), results, time.monotonic() - began)


def _summed(width: float, count: int, results: list[Result], seconds: float) -> Attempt:
    verdicts = {r.verdict for r in results}
    verdict = "sat" if "sat" in verdicts else "unknown"
    if verdicts == {"unsat"} and len(results) == count:
        verdict = "unsat"
    lower = [r.margin_lower for r in results if r.margin_lower is not None]
    upper = [r.margin_upper for r in results if r.margin_upper is not None]
    return Attempt(
        width=width,
        subsets=count,
        verdict=verdict,
        decided=1.0 if verdict != "unknown" else sum(r.decided for r in results) / count,
        network_time_s=sum(r.network_time_s or 0.0 for r in results),
        time_s=seconds,
        paths=sum(r.paths for r in results),
        leaves=sum(r.leaves for r in results),
        margin_lower=min(lower) if verdict == "unsat" else None,
        margin_upper=min(upper, default=None),
    )

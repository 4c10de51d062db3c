"""The pages, made from templates. Jinja2 escapes everything that a run says."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from harness.records import WitnessOutcome
from harness.replay import TOLERANCE
from harness.scoring import CORRECT, INCORRECT, NOTHING, OVERALL, Row
from leaderboard import history
from leaderboard.board import Board
from leaderboard.downloads import run_data
from leaderboard.questions import Question
from leaderboard.tables import LETTERS
from verifier.paper_table1 import CRASH, DNF

_HERE = Path(__file__).parent
_ASSETS = _HERE / "assets"

#: How a result can count: letter, word, and how it is shown.
VERDICTS = {
    "s": "sat", "u": "unsat", "k": "unknown", "t": "timeout", "e": "error", "x": "incorrect",
}  # fmt: skip

CATEGORY_SENTENCES = {
    OVERALL: "The percents of all categories, summed.",
    "closed_loop": "One controller, a 5, 2 or 1 mm subset of the 20 cm start range, 7 s.",
    "full_range": "The whole 20 cm start range at once, 7 s.",
    "full_scan": "Controllers that read a full scan of 1081 rays.",
    "faults": "Any fault of a stated class: rays that are missing in the turn.",
    "state_box": "Uncertain position, speed and heading at once.",
    "noise": "Every reading off by up to a bound, at every step.",
    "lap": "The 20 cm start range over a full lap of four turns.",
    "open_loop": "The network alone: steering bounds on boxes of scans (VNN-LIB).",
    "unrolled": "Steps of the closed loop unrolled into one network (VNN-LIB).",
    "quick": "Short or small questions with clear answers, seconds each.",
}


#: Of what a run says about its machine.
_LABELS = {
    "memory_mib": "Memory, MiB",
    "closedlap": "ClosedLap",
    "numpy": "NumPy",
    "onnxruntime": "onnxruntime",
}


def assets() -> Iterator[tuple[str, bytes]]:
    """Yield the files that all pages share."""
    for path in sorted(_ASSETS.iterdir()):
        yield f"assets/{path.name}", path.read_bytes()
    yield ".nojekyll", b""  # a pages host is to serve the files as they are


class Pages:
    """Renders every page of a board. slugs: of instances; pictured: those with a picture."""

    def __init__(self, board: Board, slugs: Mapping[str, str], pictured: Collection[str]) -> None:
        self.board, self.slugs, self.pictured = board, slugs, pictured
        self._tools = {tool.name: tool for tool in board.tools}
        self._environment = jinja2.Environment(
            loader=jinja2.FileSystemLoader(_HERE / "templates"),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._environment.filters |= {
            "seconds": seconds,
            "width": width,
            "day": lambda text: text[:10],
            "label": lambda key: _LABELS.get(key, key.replace("_", " ").capitalize()),
            "sentence": lambda category: CATEGORY_SENTENCES.get(category, ""),
        }
        self._environment.globals |= {
            "instance_page": lambda instance: f"instances/{slugs[instance]}.html",
            "tool_page": lambda name: f"tools/{self._tools[name].slug}.html",
            "is_tool": lambda name: name in self._tools,
            "letter_of": lambda verdict: LETTERS[verdict],
            "verdicts": VERDICTS,
            "points": {"correct": CORRECT, "incorrect": INCORRECT, "nothing": NOTHING},
            "tolerance": TOLERANCE,
            "outcomes": list(WitnessOutcome),
            "overall": OVERALL,
        }
        self._templates: dict[str, jinja2.Template] = {}

    def all(self) -> Iterator[tuple[str, bytes]]:
        """Yield the name and the content of every page."""
        board = self.board
        yield self._page("index.html", "index.html", "", rankings=self._rankings(),
                         facts=self._facts(), table1=history.table1(), table2=history.table2(),
                         dnf=DNF, crash=CRASH)  # fmt: skip
        yield self._page("plots.html", "plots.html", "")
        yield self._page("instances.html", "instances.html", "")
        yield self._page("enter.html", "enter.html", "")
        yield self._page(
            "data.html", "data.html", "", runs={t.name: run_data(t) for t in board.tools}
        )
        for tool in board.tools:
            wrong = [result for result in tool.results.values() if result.judgement.incorrect]
            yield self._page(f"tools/{tool.slug}.html", "tool.html", "../", tool=tool, wrong=wrong,
                             runs=run_data(tool), rows=_without_repeat(tool.rows))  # fmt: skip
        for question in board.instances:
            yield self._instance(question)

    def _page(self, name: str, template: str, up: str, **values: Any) -> tuple[str, bytes]:
        if template not in self._templates:
            self._templates[template] = self._environment.get_template(template)
        text = self._templates[template].render(board=self.board, up=up, **values)
        return name, text.encode()

    def _instance(self, question: Question) -> tuple[str, bytes]:
        name = f"instances/{self.slugs[question.id]}.html"
        return self._page(
            name,
            "instance.html",
            "../",
            question=question,
            results=self.board.results(question.id),
            reference=self.board.references.get(question.id),
            conflicts=self._conflicts.get(question.id, []),
            pictured=question.id in self.pictured,
            slug=self.slugs[question.id],
        )

    @property
    def _conflicts(self) -> dict[str, list[Any]]:
        if not hasattr(self, "_by_instance"):
            self._by_instance: dict[str, list[Any]] = {}
            for conflict in self.board.scores.contradictions:
                self._by_instance.setdefault(conflict.instance, []).append(conflict)
        return self._by_instance

    def _rankings(self) -> dict[str, list[Row]]:
        """Return the rows of each category, the overall ones first."""
        rankings: dict[str, list[Row]] = {OVERALL: []}
        for row in self.board.scores.rows:
            rankings.setdefault(row.category, []).append(row)
        if len(rankings) == 2:
            del rankings[OVERALL]  # one category alone is the overall ranking
        return rankings

    def _facts(self) -> dict[str, Any]:
        runs = [run for tool in self.board.tools for run in tool.runs]
        return {
            "tools": len(self.board.tools),
            "instances": len(self.board.instances),
            "results": sum(len(tool.results) for tool in self.board.tools),
            "latest": max(run.info.created_at for run in runs),
        }


def _without_repeat(rows: Sequence[Row]) -> Sequence[Row]:
    """Leave out the overall row where there is but one category."""
    return rows if len(rows) > 2 else [row for row in rows if row.category != OVERALL]


def seconds(value: float) -> str:
    """Return a time for people."""
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def width(metres: float) -> str:
    """Return a width of a start set for people."""
    return f"{1000 * metres:g} mm" if metres < 0.01 else f"{100 * metres:g} cm"

"""Tables, progress and warnings for people.

rich is imported when something is printed: with --json it never is.
"""

# ruff: noqa: PLC0415

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Self

from harness.closing import Closing
from harness.records import Record, RunInfo, Verdict, WitnessCheck, WitnessOutcome
from harness.scoring import OVERALL, Conflict, Contradiction, Row, Scores

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from harness.explain import Explanation

#: Columns where the output is not a terminal, so that IDs stay in one piece.
_WIDE = 200
_STYLES = {
    Verdict.SAT: "red",
    Verdict.UNSAT: "green",
    Verdict.UNKNOWN: "yellow",
    Verdict.TIMEOUT: "yellow",
    Verdict.ERROR: "bold red",
}


def _console(stderr: bool = False) -> Console:
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    return Console(stderr=stderr, width=None if stream.isatty() else _WIDE, highlight=False)


class ProgressBar(Closing):
    """A progress bar on standard error; nothing where that is no terminal or ``quiet``.

    total, completed: instances in all, and those that an earlier run did.
    """

    def __init__(self, total: int, completed: int, quiet: bool) -> None:
        self._running: dict[str, None] = {}
        self._bar: Progress | None = None
        if quiet or not sys.stderr.isatty():
            return
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
        from rich.progress import TimeElapsedColumn as Elapsed

        self._bar = Progress(
            MofNCompleteColumn(),
            BarColumn(),
            Elapsed(),
            TextColumn("{task.description}"),
            console=_console(stderr=True),
            transient=True,
        )
        self._bar.add_task("", total=total, completed=completed)

    def begin(self, instance: str) -> None:
        """Show that an instance runs now; may be called from any thread."""
        self._running[instance] = None
        self._describe()

    def end(self, instance: str) -> None:
        """Count an instance as done."""
        if self._bar is not None:
            self._bar.advance(self._bar.task_ids[0])
        if self._running.pop(instance, self) is None:
            self._describe()

    def note(self, text: str) -> None:
        """Show what else there is to know, where no instance is shown."""
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], description=text)

    def _describe(self) -> None:
        names = list(self._running)
        more = f" and {len(names) - 2} more" if len(names) > 2 else ""
        self.note(", ".join(names[:2]) + more)

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def close(self) -> None:
        """Take it away."""
        if self._bar is not None:
            self._bar.stop()


def print_results(results: Iterable[tuple[Record, WitnessCheck | None]]) -> None:
    """Print a table of results: instance, verdict, time, witness check."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("instance", no_wrap=True)
    table.add_column("verdict")
    table.add_column("time, s", justify="right")
    table.add_column("witness check")
    for record, check in results:
        verdict = Text(record.verdict, style=_STYLES[record.verdict])
        if record.result != record.verdict:
            verdict.append(f" ({record.result})", style="dim")
        note = Text(record.detail or "", style="dim")
        if check is not None:
            style = "" if check.credited else "bold red"
            note = Text(f"{check.outcome}: {check.message}", style=style)
        table.add_row(record.instance, verdict, f"{record.run_time:.2f}", note)
    _console().print(table)


def print_scores(scores: Scores) -> None:
    """Print the score table, the unique solves and what is at odds."""
    from rich.table import Table

    single = len({row.category for row in scores.rows}) == 2
    rows = [row for row in scores.rows if not (single and row.category == OVERALL)]
    columns = [*_COLUMNS, *(name for name in _RARE if any(_cell(row, name) != "0" for row in rows))]
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in columns:
        table.add_column(name, no_wrap=True, justify="left" if name in _COLUMNS[:2] else "right")
    for row in rows:
        cells = [_cell(row, name) for name in columns]
        table.add_row(*cells, style="bold" if row.category == OVERALL else "")
    console = _console()
    # Numbers are never cut short; a narrow terminal wraps the lines.
    wide = console.options.update(width=_WIDE)
    console.width = max(console.width, console.measure(table, options=wide).maximum)
    console.print(table)
    for row in rows:
        if row.category != OVERALL and row.unique:
            names = ", ".join(row.unique)
            text = f"only {row.tool} solved, in {row.category}: {names}"
            console.print(text, markup=False, soft_wrap=True)
    print_contradictions(scores)


_COUNTS = ("sat", "unsat", "incorrect", "unknown", "timeout", "error")
_COLUMNS = ("tool", "category", "score", "percent", *_COUNTS, "PAR-2, s")
#: Shown where some row has one.
_RARE = ("refuted", "bad_witness", "missing", "unique")


def _cell(row: Row, column: str) -> str:
    if column == "percent":
        return f"{row.percent:.1f}"
    if column == "PAR-2, s":
        return f"{row.par2_s:.2f}"
    return str(len(row.unique) if column == "unique" else getattr(row, column))


def print_contradictions(scores: Scores, stderr: bool = False) -> None:
    """Print how many contradictions there are, by kind, and each, a refuted reference loudest."""
    if not scores.contradictions:
        return
    console = _console(stderr)
    for contradiction in sorted(scores.contradictions, key=lambda c: list(Conflict).index(c.kind)):
        loud = contradiction.kind is Conflict.REFERENCE_REFUTED
        label = "REFERENCE CONTRADICTION" if loud else "contradiction"
        style = "bold white on red" if loud else "yellow"
        console.print(f"{label}: {contradiction}", style=style, markup=False, soft_wrap=True)
    counts = ", ".join(f"{count} {kind}" for kind, count in scores.by_kind().items() if count)
    console.print(f"contradictions: {counts}", markup=False, soft_wrap=True)


def print_explanations(
    instance: str,
    reference: str,
    explanations: Iterable[Explanation],
    contradictions: Iterable[Contradiction],
) -> None:
    """Print why every result of an instance got its points."""
    console = _console()
    console.print(instance, style="bold", markup=False, soft_wrap=True)
    console.print(reference, markup=False, soft_wrap=True)
    for explanation in explanations:
        points, claim = explanation.judgement.points, explanation.judgement.claim
        style = "green" if points > 0 else "bold red" if points < 0 else "yellow"
        console.print(f"\n{claim.tool}: {points} points", style=style, markup=False)
        for sentence in explanation.sentences:
            console.print(f"  {_one_line(sentence)}", markup=False, soft_wrap=True)
    for contradiction in contradictions:
        console.print(f"\ncontradiction: {contradiction}", markup=False, soft_wrap=True)


def explanation_data(explanation: Explanation, reference: str) -> dict[str, Any]:
    """Return an explanation for JSON."""
    claim, record, check = explanation.judgement.claim, explanation.record, explanation.check
    return {
        "tool": claim.tool,
        "category": claim.category,
        "instance": claim.instance,
        "points": explanation.judgement.points,
        "verdict": str(record.verdict),
        "counted": str(claim.counted),
        "result": record.result,
        "run_time": record.run_time,
        "limit_s": record.limits.wall_s,
        "reference": reference,
        "reasons": explanation.sentences,
        "witness_check": check.model_dump(mode="json") if check else None,
    }


def _one_line(text: str) -> str:
    """Return text that may be a tool's on one line, without what a terminal would obey."""
    return "".join(c if c.isprintable() else " " for c in text)


def print_machine(info: RunInfo) -> None:
    """Print which tool ran on what machine."""
    machine = info.machine
    parts = [
        f"run of {info.tool.name} {info.tool.version or '(no version)'}, begun {info.created_at}",
        f"{machine.get('processor')}, {machine.get('usable_cores')} cores",
        f"{machine.get('memory_mib')} MiB, {machine.get('system')}",
    ]
    _console().print(_one_line("; ".join(parts)), markup=False, soft_wrap=True)


def print_check(check: WitnessCheck) -> None:
    """Print the check of one witness."""
    console = _console()
    style = "green" if check.outcome is WitnessOutcome.CORRECT else "bold red"
    if check.outcome is WitnessOutcome.CORRECT_WITH_TOLERANCE:
        style = "yellow"
    console.print(f"{check.outcome}: {check.message}", style=style, markup=False, soft_wrap=True)
    console.print(check.outcome.sentence, markup=False, soft_wrap=True)


def row_data(row: Row, scores: Scores) -> dict[str, Any]:
    """Return a row for JSON.

    contradictions: of its category (overall: all); disagreements: how many of each kind its tool
    has a part in.
    """
    category = None if row.category == OVERALL else row.category
    return {
        **vars(row),
        "disagreements": {str(k): n for k, n in scores.by_kind(row.tool, category).items()},
        "contradictions": [
            {"kind": str(c.kind), "instance": c.instance, "sat": c.sat, "unsat": c.unsat}
            for c in scores.contradictions
            if row.category in (OVERALL, c.category)
        ],
    }

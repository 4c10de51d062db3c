"""What the site shows, as plain data: tools, instances, results and how they were judged.

Nothing is judged here: points, reasons and ranks are harness.scoring's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from harness.catalogue import Reference
from harness.records import Record, RunInfo, WitnessCheck
from harness.scoring import Contradiction, Judgement, Row, Scores
from leaderboard.questions import Question


@dataclass(frozen=True)
class Run:
    """One run of a tool.

    limits: for each limit what was asked or kept, as text.
    """

    sha256: str
    info: RunInfo
    instances: int
    limits: Mapping[str, str]


@dataclass(frozen=True)
class Result:
    """One tool's judged result on one instance.

    log: what the tool printed, shortened; log_bytes: its length in the run; witness: what
    followed ``sat``, as text, shortened.
    """

    record: Record
    judgement: Judgement
    check: WitnessCheck | None
    run: Run
    log: str
    log_bytes: int
    witness: str | None = None


@dataclass(frozen=True)
class Tool:
    """A tool with all its runs; slug: its name in addresses."""

    name: str
    slug: str
    runs: Sequence[Run]
    rows: Sequence[Row]
    results: Mapping[str, Result]
    contradictions: Sequence[Contradiction]

    @property
    def versions(self) -> list[str]:
        """Every version that ran."""
        return list(dict.fromkeys(run.info.tool.version or "not stated" for run in self.runs))


@dataclass(frozen=True)
class Board:
    """Everything on the site. tools: the best overall first; instances: by category, then ID."""

    tools: Sequence[Tool]
    instances: Sequence[Question]
    scores: Scores
    references: Mapping[str, Reference]
    notes: Sequence[str] = field(default_factory=tuple)

    @property
    def categories(self) -> list[str]:
        """Every category that some tool ran on."""
        return list(dict.fromkeys(question.category for question in self.instances))

    def results(self, instance: str) -> list[Result]:
        """Return all results on an instance, the best tool's first."""
        return [tool.results[instance] for tool in self.tools if instance in tool.results]

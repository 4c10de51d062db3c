"""From runs to what the site shows: read, score, and put together."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from harness.checks import witness_check
from harness.evidence import gather
from harness.records import Limits, Record, Verdict
from harness.scoring import OVERALL, score
from leaderboard.board import Board, Result, Run, Tool
from leaderboard.questions import read_questions
from leaderboard.runs import JudgedRun

#: Characters of a witness that are shown.
_LONGEST_WITNESS = 400
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,99}")


def collect(runs: Sequence[JudgedRun], root: Path | None, longest_log: int) -> Board:
    """Score the runs and return what the site shows; BadInput as harness.evidence.gather.

    root: the benchmarks folder; longest_log: so many bytes of each log are shown.
    """
    evidence = gather(runs, root)
    scores = score(evidence.claims, evidence.references)
    judged = {(j.claim.tool, j.claim.instance): j for j in scores.judgements}
    by_tool: dict[str, list[Run]] = {}
    results: dict[str, dict[str, Result]] = {}
    for folder in runs:
        records = folder.records()
        run = Run(
            folder.sha256, folder.shared, len(records), limits_text(r.limits for r in records)
        )
        for name in {record.tool: None for record in records}:
            by_tool.setdefault(name, []).append(run)
        for record in records:
            judgement = judged[record.tool, record.instance]
            log = folder.log(record)
            witness = folder.witness(record) if record.verdict is Verdict.SAT else None
            results.setdefault(record.tool, {})[record.instance] = Result(
                record=record,
                judgement=judgement,
                check=witness_check(folder, record, root),
                run=run,
                log=shorten(log, longest_log),
                log_bytes=len(log),
                witness=None if witness is None else shorten(witness, _LONGEST_WITNESS),
            )
    ranked = [row.tool for row in scores.rows if row.category == OVERALL]
    slugs = make_slugs(ranked)
    tools = [
        Tool(
            name=name,
            slug=slugs[name],
            runs=by_tool[name],
            rows=[row for row in scores.rows if row.tool == name],
            results=results[name],
            contradictions=[c for c in scores.contradictions if name in (*c.sat, *c.unsat)],
        )
        for name in ranked
    ]
    records_of_all: Iterable[Record] = (record for run in runs for record in run.records())
    questions = read_questions(records_of_all, root)
    return Board(tools, questions, scores, evidence.references, evidence.notes)


def shorten(content: bytes, longest: int) -> str:
    """Return bytes as text, without the middle where there are more than ``longest``."""
    if len(content) > longest:
        half = longest // 2
        left_out = f"\n[... {len(content) - 2 * half} bytes left out ...]\n"
        content = content[:half] + left_out.encode() + content[len(content) - half :]
    text = content.decode("utf-8", errors="replace")
    # Control characters have no place in a page.
    return _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text.replace("\r\n", "\n").replace("\r", "\n"))


def make_slugs(names: Iterable[str]) -> dict[str, str]:
    """Return for each name one that is good in addresses and files, also where case is ignored."""
    slugs: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        slug = name
        if not _PLAIN.fullmatch(name) or name.lower() in taken:
            digest = hashlib.sha256(name.encode()).hexdigest()[:12]
            slug = re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-.")[:40] + "-" + digest
            slug = slug.lstrip("-")
        taken.add(slug.lower())
        slugs[name] = slug
    return slugs


def limits_text(limits: Iterable[Limits]) -> dict[str, str]:
    """Return each limit's meaning with the values it had in a run: one, or least to largest."""
    values: dict[str, set[object]] = {}
    for one in limits:
        for name in Limits.model_fields:
            value = getattr(one, name)
            plain = value is None or isinstance(value, int | float | str)
            values.setdefault(name, set()).add(value if plain else str(value))
    return {_LIMIT_NAMES.get(name, name): _range(name, found) for name, found in values.items()}


_LIMIT_NAMES = {
    "wall_s": "Wall time given to the tool",
    "wall_end_s": "Told to end after",
    "wall_kill_s": "Killed after",
    "prepare_wall_s": "Wall time to prepare",
    "cpu_s": "CPU time",
    "memory_mib": "Memory",
    "kept_by": "Processes found by",
}
_UNITS = {"_s": " s", "_mib": " MiB"}


def _range(name: str, values: set[object]) -> str:
    unit = next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "")
    numbers = sorted(value for value in values if isinstance(value, int | float))
    parts = [str(value) for value in values if value is not None and value not in numbers]
    if numbers:
        low, high = f"{numbers[0]:g}", f"{numbers[-1]:g}"
        parts.append((low if low == high else f"{low} to {high}") + unit)
    if None in values:
        parts.append("not limited")
    return ", ".join(sorted(parts))

"""Data that pages' scripts read: short, since every instance and every result is in it.

Scripts, not JSON: a page opened from the file system may load scripts only.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from harness.records import Verdict
from leaderboard.board import Board, Result, Tool

#: One letter for each way that a result can count.
LETTERS = {
    Verdict.SAT: "s", Verdict.UNSAT: "u", Verdict.UNKNOWN: "k", Verdict.TIMEOUT: "t",
    Verdict.ERROR: "e",
}  # fmt: skip
INCORRECT, NOT_RUN = "x", "-"


def letter(result: Result | None) -> str:
    """Return how a result counts: a verdict, incorrect, or not run."""
    if result is None:
        return NOT_RUN
    return INCORRECT if result.judgement.incorrect else LETTERS[result.judgement.claim.counted]


def tables(board: Board, slugs: Mapping[str, str]) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the content of each script.

    slugs: of instances. The results of a tool are in the order of the instances.
    """
    yield "data/instances.js", _assign("instances", _instances(board, slugs))
    names = [{"name": tool.name, "slug": tool.slug} for tool in board.tools]
    yield "data/tools.js", _assign("tools", names)
    for tool in board.tools:
        yield f"data/results/{tool.slug}.js", _register(tool, _results(board, tool))


def _instances(board: Board, slugs: Mapping[str, str]) -> dict[str, Any]:
    categories = board.categories
    index = {name: i for i, name in enumerate(categories)}
    rows = []
    for question in board.instances:
        results = board.results(question.id)
        letters = "".join(letter(result) for result in results)
        reference = board.references.get(question.id)
        slug = slugs[question.id]
        rows.append(
            [
                question.id,
                0 if slug == question.id else slug,
                index[question.category],
                question.controller,
                question.rays,
                question.neurons,
                question.width,
                question.timeout,
                letters.count("s"),
                letters.count("u"),
                letters.count(INCORRECT),
                LETTERS[reference.verdict] if reference else 0,
            ]
        )
    columns = ["id", "slug", "category", "controller", "rays", "neurons", "width", "timeout",
               "sat", "unsat", "incorrect", "reference"]  # fmt: skip
    return {"categories": categories, "columns": columns, "rows": rows}


def _results(board: Board, tool: Tool) -> dict[str, Any]:
    results = [tool.results.get(question.id) for question in board.instances]
    return {
        "letters": "".join(letter(result) for result in results),
        "times": [result and round(result.record.run_time, 3) for result in results],
    }


def _assign(name: str, data: Any) -> bytes:
    return f"ClosedLap.{name} = {_text(data)};\n".encode()


def _register(tool: Tool, data: Any) -> bytes:
    return f"ClosedLap.results[{_text(tool.slug)}] = {_text(data)};\n".encode()


def _text(data: Any) -> str:
    return json.dumps(data, separators=(",", ":"), allow_nan=False)

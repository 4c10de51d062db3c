"""The data behind the site, as CSV and JSON, each result with the hash of its run."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Sequence
from typing import Any

from harness.scoring import Row
from leaderboard.board import Board, Result, Tool


def result_data(result: Result) -> dict[str, Any]:
    """Return a judged result as flat data; seconds, MiB, metres."""
    record, check = result.record, result.check
    return {
        "tool": record.tool,
        "tool_version": record.tool_version,
        "category": record.category,
        "instance": record.instance,
        "result": record.result,
        "verdict": str(result.judgement.claim.counted),
        "points": result.judgement.points,
        "reason": result.judgement.reason,
        "run_time": round(record.run_time, 3),
        "prepare_time": round(record.prepare_time, 3),
        "cpu_time": round(record.cpu_time, 3),
        "max_memory_mib": round(record.max_memory_mib, 1),
        "timeout": record.limits.wall_s,
        "witness_outcome": str(check.outcome) if check else None,
        "witness_margin": check.margin if check else None,
        "onnx_sha256": record.onnx_sha256,
        "spec_sha256": record.spec_sha256,
        "run_sha256": result.run.sha256,
    }


def row_data(row: Row) -> dict[str, Any]:
    """Return a row of the ranking as flat data."""
    data = dict(vars(row))
    data["percent"] = round(row.percent, 3)
    data["par2_s"] = round(row.par2_s, 3)
    data["unique"] = len(row.unique)
    return data


def run_data(tool: Tool) -> list[dict[str, Any]]:
    """Return a tool's runs as data, without the paths and names of the machine's owner."""
    return [
        {
            "run_sha256": run.sha256,
            "created_at": run.info.created_at,
            "harness_version": run.info.harness_version,
            "tool_version": run.info.tool.version,
            "scripts_sha256": run.info.tool.scripts_sha256,
            "instances": run.instances,
            "machine": {k: v for k, v in run.info.machine.items() if k != "host"},
            "limits": dict(run.limits),
        }
        for run in tool.runs
    ]


def downloads(board: Board) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the content of each file: the scores, and the results of each tool."""
    rows = [row_data(row) for row in board.scores.rows]
    runs = [{"tool": tool.name, **run} for tool in board.tools for run in run_data(tool)]
    yield "data/scores.csv", _csv(rows)
    contradictions = [
        {"kind": str(c.kind), "category": c.category, "instance": c.instance, "sat": c.sat,
         "unsat": c.unsat}
        for c in board.scores.contradictions
    ]  # fmt: skip
    scores = {"format": "closedlap-scores", "version": "1.0", "runs": runs, "rows": rows,
              "contradictions": contradictions}  # fmt: skip
    yield "data/scores.json", _json(scores)
    for tool in board.tools:
        results = [result_data(result) for result in tool.results.values()]
        data = {"format": "closedlap-results", "version": "1.0", "tool": tool.name,
                "runs": run_data(tool), "results": results}  # fmt: skip
        yield f"data/results/{tool.slug}.csv", _csv(results)
        yield f"data/results/{tool.slug}.json", _json(data)


def _csv(rows: Sequence[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(rows[0])
    writer.writerows(row.values() for row in rows)
    return text.getvalue().encode()


def _json(data: Any) -> bytes:
    return (json.dumps(data, separators=(",", ":"), allow_nan=False) + "\n").encode()

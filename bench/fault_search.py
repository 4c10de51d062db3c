"""How far a strong search gets with the faults of the dataset: a witness, or none found.

    python -m bench.fault_search [PATTERN...] [--seconds S] [--jobs N] [--table] [--json]

PATTERN: of the instances' IDs, as in a shell; default: the instances of category ``faults`` with
mirrors, and those with noise and missing rays. Each is searched on one core for S seconds (the
witness search of the reference verifier, which begins anew where it is stuck) or until a witness
is found, which counts only if the harness's own replay of it is ``correct``. Prints one line for
each; with --table, a Markdown table of questions and controllers: ``sat``, or the least margin
(mm) that was found.
"""

# ruff: noqa: E402 (the environment must be set before NumPy is imported)

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

from harness.records import WitnessOutcome
from harness.replay import check_witness
from racecar.controller import RuntimeSteer
from racecar.instance import controller_path
from verifier.falsify import confirmed, worst_start
from verifier.problem import load_problem

INSTANCES = Path(__file__).resolve().parents[1] / "benchmarks" / "faults" / "json"
PATTERNS = ("*.faults.mirror*", "*.faults.n*")
SECONDS = 20.0
#: More runs than any budget of time allows.
RUNS = 10**9


def search(path: Path, seconds: float) -> dict[str, object]:
    """Search one instance; return what was found."""
    instance, problem = load_problem(path)
    steer = RuntimeSteer(controller_path(instance, path))
    began = time.monotonic()
    worst = worst_start(
        problem, steer, problem.lower, problem.upper, runs=RUNS, seconds=seconds, again=True
    )
    found = {
        "instance": instance.id,
        "result": "not found",
        "margin": worst.margin,
        "time_s": round(time.monotonic() - began, 2),
    }
    if worst.margin <= 0 and confirmed(problem, steer, worst):
        text = json.dumps(worst.witness()).encode()
        check = check_witness(instance, path, text)
        if check.outcome is WitnessOutcome.CORRECT:
            found |= {"result": "sat", "margin": check.margin, "witness": worst.witness()}
    return found


def table(found: Sequence[dict[str, object]]) -> str:
    """Return a Markdown table: a row for each question, a column for each controller."""
    cells: dict[str, dict[str, str]] = {}
    for one in found:
        controller, _, question = str(one["instance"]).split(".", 2)
        sat = one["result"] == "sat"
        text = "sat" if sat else f"{1000 * float(str(one['margin'])):.1f}"
        cells.setdefault(question, {})[controller] = text
    controllers = sorted({c for row in cells.values() for c in row})
    lines = [["question", *controllers], ["---"] * (len(controllers) + 1)]
    lines += [[q, *(row.get(c, "") for c in controllers)] for q, row in cells.items()]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    """Search, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("patterns", nargs="*", default=PATTERNS)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    paths = [
        path
        for path in sorted(INSTANCES.glob("*.json"))
        if any(fnmatchcase(path.stem, pattern) for pattern in arguments.patterns)
    ]
    found = []
    with ProcessPoolExecutor(arguments.jobs) as pool:
        for one in pool.map(partial(search, seconds=arguments.seconds), paths):
            found.append(one)
            if arguments.json:
                print(json.dumps(one), flush=True)
            elif not arguments.table:
                margin = 1000 * float(str(one["margin"]))
                print(
                    f"{one['result']:9} {margin:9.3f} mm {one['time_s']:6.2f} s  {one['instance']}"
                )
    if arguments.table:
        print(table(found))


if __name__ == "__main__":
    main()

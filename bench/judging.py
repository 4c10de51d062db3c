"""Speed of judging: scoring many results, and reading VNN-LIB beside its official parser.

    python -m bench.judging [--json]

Each round measures all of them; medians over the rounds are reported, so that load on the
machine touches all alike. Times are of one core.
"""

from __future__ import annotations

import json
import random
import sys
from pathlib import Path
from statistics import median
from time import process_time

import vnnlib
from harness.query.evaluate import evaluate
from harness.query.network import read_unpacked
from harness.query.read import read_query
from harness.records import Verdict, WitnessOutcome
from harness.scoring import Claim, score

RESULTS, ROUNDS = 100_000, 5
VNNLIB = Path(__file__).parents[1] / "vnnlib"


def many_claims() -> list[Claim]:
    """Return the results of ten tools on 10,000 instances."""
    draw = random.Random(0)
    return [
        Claim(
            f"tool{i % 10}",
            f"category{i // 20_000}",
            f"instance{i // 10}",
            draw.choice(list(Verdict)),
            draw.random(),
            60.0,
            draw.choice(list(WitnessOutcome)),
        )
        for i in range(RESULTS)
    ]


def measure() -> dict[str, float]:
    """Return medians: seconds, and ratios of seconds."""
    claims = many_claims()
    path = max(VNNLIB.glob("*/2.0/*"), key=lambda path: path.stat().st_size)
    text = read_unpacked(path).decode()
    query = read_query(text, path.name)
    values = [[0] * tensor.size for tensor in query.tensors]
    times: dict[str, list[float]] = {"score": [], "official": [], "read": [], "evaluate": []}
    for _ in range(ROUNDS):
        for name, work in (
            ("score", lambda: score(claims, {})),
            ("official", lambda: vnnlib.parse_query_string(text)),
            ("read", lambda: read_query(text, path.name)),
            ("evaluate", lambda: evaluate(query, values)),
        ):
            begin = process_time()
            work()
            times[name].append(process_time() - begin)
    return {
        "score_100000_s": median(times["score"]),
        "read_largest_s": median(times["read"]),
        "read_beside_official_parser": median(times["read"]) / median(times["official"]),
        "evaluate_beside_read": median(times["evaluate"]) / median(times["read"]),
    }


def main() -> None:
    """Print the figures."""
    found = measure()
    if "--json" in sys.argv[1:]:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            print(f"{name:30} {value:.3g}")


if __name__ == "__main__":
    main()

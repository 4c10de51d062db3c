"""What checking a row costs: the network in doubles for many rows at once, and in Arb.

    python -m bench.checking CERTIFICATE INSTANCE [--rows N]

All of it on one core, in one run; times are CPU times per row that drives.
"""

from __future__ import annotations

import argparse
import random
import time
from pathlib import Path

from checker.batch import Batch
from checker.files import Kind, read_certificate, read_instance
from checker.inclusion import state_of
from checker.rows import Checker
from checker.step import Network


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("certificate", type=Path)
    parser.add_argument("instance", type=Path)
    parser.add_argument("--rows", type=int, default=128, metavar="N")
    given = parser.parse_args()
    certificate, instance = read_certificate(given.certificate), read_instance(given.instance)
    checker, rows = Checker(certificate, instance), certificate.rows
    driven = sorted({row.parent for row in rows if row.kind == Kind.IMAGE})
    chosen = random.Random(0).sample(driven, min(given.rows, len(driven)))

    began = time.process_time()
    checker.check_rows(chosen)
    whole = time.process_time() - began
    views = [
        checker._view(rows[i], state_of(rows[i]), checker.forest.assumptions(i)) for i in chosen
    ]
    scans = [checker.sensors.readings(view, []) for view in views]
    began = time.process_time()
    quick = Batch(instance.layers).steering(scans)
    fast = time.process_time() - began
    began = time.process_time()
    exact = list(map(Network(instance.layers).steering, scans))
    slow = time.process_time() - began
    more = max(
        float(a[-1].rad()) - float(b[-1].rad())
        for a, b in zip(quick, exact, strict=True)
        if a is not None
    )
    each = 1000 / len(chosen)
    print(f"{len(chosen)} rows, all that is checked of one: {whole * each:.2f} ms")
    print(f"its network in doubles {fast * each:.2f} ms, in Arb {slow * each:.2f} ms")
    print(f"ratio {slow / fast:.1f}; rests larger by up to {more:.1e} rad")


if __name__ == "__main__":
    main()

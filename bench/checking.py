"""What checking a row costs: in doubles for many rows at once, and in Arb.

    python -m bench.checking CERTIFICATE INSTANCE [--rows N]

All of it on one core, in one run; times are CPU times per row that drives.
"""

from __future__ import annotations

import argparse
import random
import time
from pathlib import Path

from threadpoolctl import threadpool_limits

from checker.batch import of_rows
from checker.batch_lidar import readings
from checker.batch_network import BatchNetwork
from checker.files import Kind, read_certificate, read_instance
from checker.inclusion import state_of
from checker.rows import Checker
from checker.step import Network


@threadpool_limits.wrap(limits=1)
def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("certificate", type=Path)
    parser.add_argument("instance", type=Path)
    parser.add_argument("--rows", type=int, default=256, metavar="N")
    given = parser.parse_args()
    certificate, instance = read_certificate(given.certificate), read_instance(given.instance)
    checker, rows = Checker(certificate, instance), certificate.rows
    driven = sorted({row.parent for row in rows if row.kind == Kind.IMAGE})
    frame = max(range(len(checker.frames)), key=[rows[i].frame for i in driven].count)
    driven = [i for i in driven if rows[i].frame == frame]
    chosen = random.Random(0).sample(driven, min(given.rows, len(driven)))
    obstacles, each = checker.frames[frame]["obstacles"], 1000 / len(chosen)

    def timed(work):
        began = time.process_time()
        out = work()
        return out, (time.process_time() - began) * each

    _, whole = timed(lambda: checker.check_rows(chosen))
    assumed = [checker.forest.assumptions(i) for i in chosen]
    states = of_rows([rows[i] for i in chosen])
    (read, proved), fast_lidar = timed(
        lambda: readings(checker.sensors.rays, obstacles, states, [x.crosses for x in assumed])
    )
    views = [
        checker._view(rows[i], state_of(rows[i]), signs)
        for i, signs in zip(chosen, assumed, strict=True)
    ]
    scans, slow_lidar = timed(lambda: [checker.sensors.readings(view, []) for view in views])
    noisy = checker.sensors.disturbed(read, [])
    network = BatchNetwork(instance.layers)
    ahead = [noisy.at(k) for k in range(len(chosen))]
    step = network.at_once(noisy.middle.shape[-1])
    parts = [ahead[k : k + step] for k in range(0, len(ahead), step)]
    quick, fast = timed(lambda: [y for part in parts for y in network.steering(part)])
    exact, slow = timed(lambda: list(map(Network(instance.layers).steering, scans)))
    answers = {i: [y] for i, y in zip(chosen, quick, strict=True) if y is not None}
    through, fast_period = timed(lambda: checker._driven(answers))

    def period(i):
        image = rows[checker.forest.children[i][0]]
        checker._check_period(rows[i], state_of(rows[i]), answers[i], image, ())

    _, slow_period = timed(lambda: list(map(period, sorted(through))))
    slow_period *= len(answers) / len(through)
    more = max(
        float(a[-1].rad()) - float(b[-1].rad())
        for a, b in zip(quick, exact, strict=True)
        if a is not None
    )
    print(f"{len(chosen)} rows, all that is checked of one: {whole:.2f} ms")
    for name, doubles, arb in (
        ("readings", fast_lidar, slow_lidar), ("network", fast, slow),
        ("arc, clearance and image", fast_period, slow_period),
    ):  # fmt: skip
        print(f"{name} in doubles {doubles:.2f} ms, in Arb {arb:.2f} ms: ratio {arb / doubles:.1f}")
    print(f"readings proved in doubles: {proved.mean():.2%}; rests larger by up to {more:.1e} rad")
    print(f"periods proved in doubles: {len(through) / len(chosen):.2%}")


if __name__ == "__main__":
    main()

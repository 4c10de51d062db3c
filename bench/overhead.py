"""What the harness takes for each instance beyond the tool's own two scripts.

    python -m bench.overhead [--instances N] [--json]

The tool answers at once. Each round runs its two scripts bare (subprocess.run), then through the
harness without control groups, then with them where they work, then through BenchExec's
RunExecutor; the medians of the differences from the bare run of the same round are reported, so
that load on the machine touches all alike.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median, quantiles
from time import perf_counter

from harness.catalogue import Entry
from harness.limits import Allowance
from harness.runner import Runner
from harness.tool import PREPARE, RUN, Tool, find_tool

SCRIPTS = {PREPARE: '[ "$1" = v1 ]\n', RUN: 'echo unknown > "$5"\n'}


def make_tool(folder: Path) -> Tool:
    """Return a tool that answers at once."""
    folder.mkdir()
    for name, text in SCRIPTS.items():
        (folder / name).write_text(text)
    return find_tool(str(folder))


def bare(tool: Tool, entry: Entry, results: Path) -> None:
    """Run the scripts as they are."""
    arguments = [entry.category, str(entry.onnx), str(entry.spec)]
    subprocess.run(tool.command(PREPARE, *arguments), check=True)
    subprocess.run(tool.command(RUN, *arguments, str(results), "10"), check=True)


def benchexec_runner(
    tool: Tool, entry: Entry, results: Path, log: Path
) -> Callable[[], None] | None:
    """Return what runs the scripts through BenchExec, or None where it cannot."""
    logging.disable(logging.CRITICAL)
    try:
        from benchexec.runexecutor import RunExecutor  # noqa: PLC0415 (slow)

        executor = RunExecutor(use_namespaces=False)
    except (ImportError, SystemExit):
        return None
    arguments = [entry.category, str(entry.onnx), str(entry.spec)]
    commands = [
        tool.command(PREPARE, *arguments),
        tool.command(RUN, *arguments, str(results), "10"),
    ]

    def run() -> None:
        for command in commands:
            done = executor.execute_run(command, str(log), walltimelimit=60)
            assert done["exitcode"].value == 0, done

    return run


def answered(runner: Runner, entry: Entry) -> None:
    """Run an instance and make sure that it was run."""
    record = runner.run(entry).record
    assert record.result == "unknown", record


def measure(instances: int) -> dict[str, dict[str, float]]:
    """Return each way's overhead per instance in ms: median, and 90 percent are below."""
    took: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tool = make_tool(folder / "tool")
        spec = folder / "one.json"
        spec.write_text("{}")
        results = folder / "results"
        entry = Entry("one", "quick", spec, spec, 10.0)
        with (
            Runner(tool, None, limits=Allowance(cgroups=False)) as fallback,
            Runner(tool, None) as grouped,
        ):
            uses_groups = fallback.run(entry).record.limits != grouped.run(entry).record.limits
            ways: dict[str, Callable[[], None] | None] = {
                "bare": lambda: bare(tool, entry, results),
                "harness, fallback": lambda: answered(fallback, entry),
                "harness, cgroups": (lambda: answered(grouped, entry)) if uses_groups else None,
                "BenchExec": benchexec_runner(tool, entry, results, folder / "log"),
            }
            for _ in range(instances):
                for way, run in ways.items():
                    if run is None:
                        continue
                    start = perf_counter()
                    run()
                    took.setdefault(way, []).append(1000 * (perf_counter() - start))
    report = {}
    for way, times in took.items():
        base = [0.0] * len(times) if way == "bare" else took["bare"]
        extra = [time - without for time, without in zip(times, base, strict=True)]
        report[way] = {"median_ms": median(extra), "below_90_ms": quantiles(extra, n=10)[-1]}
    return report


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--instances", type=int, default=500)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    report = measure(options.instances)
    if options.json:
        print(json.dumps({"instances": options.instances, **report}))
        return
    print(f"{options.instances} instances, {os.cpu_count()} cores, Python {sys.version.split()[0]}")
    for way, row in report.items():
        what = "itself" if way == "bare" else "more than bare"
        print(
            f"{way:20} {row['median_ms']:8.1f} ms {what} (median), "
            f"90 % below {row['below_90_ms']:.1f} ms"
        )


if __name__ == "__main__":
    main()

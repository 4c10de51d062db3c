"""Building and opening the leaderboard of many made-up runs.

    python -m bench.leaderboard [--tools 20] [--instances 6000] [--keep DIR] [--no-browser]

Made-up runs are written through the store's own interface: instances of the committed controllers,
tools that solve a share of them each, witnesses from the corners of the start sets, a log for
each. Then the site is built twice: from nothing, and with nothing changed. Wall and CPU times are
printed, and CPU times as ratios to reading the runs alone; sizes in bytes; and, in headless
Chromium, how long pages take until their scripts have run.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np

from harness.catalogue import Entry, sha256
from harness.machine import describe_machine
from harness.records import Limits, Record, RunInfo, ToolInfo, Verdict, WitnessCheck, WitnessOutcome
from harness.store import RunFolder
from leaderboard.build import Built, Options, build
from leaderboard.runs import find_runs

REPOSITORY = Path(__file__).resolve().parents[1]
CONTROLLERS = ("TD3_L21_64x64_C1", "TD3_L21_128x128_C1", "DDPG_L21_64x64_C1", "DDPG_L21_128x128_C1")
#: Categories, with their share of the instances, the width of the start set (m) and the limit (s).
CATEGORIES = (
    ("closed_loop", 0.75, (0.005, 0.002, 0.001), 60.0),
    ("full_range", 0.05, (0.2,), 300.0),
    ("noise", 0.1, (0.02, 0.01), 120.0),
    ("faults", 0.1, (0.02, 0.01), 120.0),
)
PARTS = {
    "front page with its scripts and styles": (
        "index.html", "assets/site.css", "assets/theme.js", "assets/state.js",
        "assets/ranking.js", "assets/icon.svg",
    ),
    "plots' data": ("data/*.js", "data/results/*.js"),
    "everything": ("**/*",),
}  # fmt: skip
DISTURBANCES = {
    "noise": {"noise": 0.002, "missing": 0, "turn_only": False, "choice": "run"},
    "faults": {"noise": 0.0, "missing": 1, "turn_only": True, "choice": "run"},
}


def write_instances(root: Path, count: int) -> list[Entry]:
    """Write a benchmarks folder of so many instances."""
    networks = root.parent / "onnx"
    networks.mkdir(parents=True)
    for name in CONTROLLERS:
        shutil.copy(REPOSITORY / "onnx" / f"{name}.onnx", networks)
    model = {name: json.loads((_full_range(name)).read_bytes()) for name in CONTROLLERS}
    entries = []
    for category, share, widths, timeout in CATEGORIES:
        folder = root / category / "json"
        folder.mkdir(parents=True)
        rows = []
        for i in range(round(share * count)):
            controller, width = CONTROLLERS[i % 4], widths[i // 4 % len(widths)]
            low = round(0.65 + (i * 0.0007) % (0.2 - width + 1e-9), 6)
            name = f"{controller}.{category}.w{1000 * width:g}mm.{i:04}.clearance"
            data = model[controller] | {"id": name, "category": category}
            data["initial_set"] = data["initial_set"] | {"s": [low, round(low + width, 6)]}
            if category in DISTURBANCES:
                data["disturbance"] = DISTURBANCES[category]
            spec = folder / f"{name}.json"
            spec.write_text(json.dumps(data))
            rows.append(f"../../onnx/{controller}.onnx,json/{name}.json,{timeout:g}\n")
            entries.append(Entry(name, category, networks / f"{controller}.onnx", spec, timeout))
        (root / category / "instances.csv").write_text("".join(rows))
    return entries


def _full_range(controller: str) -> Path:
    return REPOSITORY / f"benchmarks/full_range/json/{controller}.full_range.clearance.json"


def write_run(path: Path, name: str, seed: int, root: Path, entries: list[Entry]) -> None:
    """Write a run of a made-up tool; some of its answers are wrong."""
    random = np.random.default_rng(seed)
    skill = random.uniform(0.3, 0.97)
    folder = RunFolder.create(path)
    lock = folder.lock()
    info = RunInfo(
        tool=ToolInfo(
            name=name, version=f"{seed % 4}.{seed % 7}", folder=name, scripts_sha256="0" * 64
        ),
        benchmarks=None,
        timeout_s=None,
        created_at=f"2026-10-{1 + seed % 28:02}T12:00:00+00:00",
        harness_version="0.1.0",
        machine=describe_machine(),
    )
    folder.write_info(info)
    database = folder._open()
    database.execute("PRAGMA synchronous = OFF")  # made-up results may be lost
    for entry in entries:
        # All tools agree on what is true, but for a few that are wrong.
        truth = hashlib.sha256(entry.id.encode()).digest()[0] < 51
        draw = random.random()
        verdict = Verdict.SAT if truth else Verdict.UNSAT
        if draw > skill:
            verdict = (Verdict.TIMEOUT, Verdict.UNKNOWN, Verdict.ERROR)[seed % 3]
        elif draw < 0.001:
            verdict = Verdict.UNSAT if truth else Verdict.SAT
        add(folder, name, root, entry, verdict, truth, float(random.lognormal(0.5, 1.2)))
    folder.finish()
    folder.close()
    os.close(lock)


def add(
    folder: RunFolder,
    tool: str,
    root: Path,
    entry: Entry,
    verdict: Verdict,
    truth: bool,
    seconds: float,
) -> None:
    seconds = min(seconds, entry.timeout)
    onnx, spec = _hashes(entry)
    record = Record(
        instance=entry.id,
        category=entry.category,
        onnx=os.path.relpath(entry.onnx, root),
        spec=os.path.relpath(entry.spec, root),
        onnx_sha256=onnx,
        spec_sha256=spec,
        tool=tool,
        tool_version=None,
        command=["run"],
        started_at="2026-10-01T12:00:00.000+00:00",
        prepare_time=0.01,
        run_time=seconds,
        cpu_time=0.9 * seconds,
        max_memory_mib=150.0,
        result=str(verdict),
        verdict=verdict,
        limits=Limits(
            wall_s=entry.timeout,
            wall_end_s=entry.timeout + 0.1,
            wall_kill_s=entry.timeout + 0.25,
            prepare_wall_s=600,
            kept_by="subreaper",
        ),
        log=f"{entry.id}.log",
    )
    witness, check = None, None
    if verdict is Verdict.SAT:
        low = json.loads(entry.spec.read_bytes())["initial_set"]["s"][0]
        witness = json.dumps({"s": low, "f": 9.9, "v": 0.0, "theta": 0.0}).encode()
        check = WitnessCheck(
            instance=entry.id,
            outcome=WitnessOutcome.CORRECT if truth else WitnessOutcome.WRONG,
            message="made up",
            margin=-0.01 if truth else 0.05,
            outside=0.0,
            witness_sha256=hashlib.sha256(witness).hexdigest(),
            spec_sha256=spec,
            onnx_sha256=onnx,
            checked_with={},
        )
    log = f"{tool} begins {entry.id}\n" + "step done, nothing to see\n" * 12 + f"{verdict}\n"
    folder.add(record, log=log.encode(), witness=witness, check=check)


_known: dict[Path, str] = {}


def _hashes(entry: Entry) -> list[str]:
    for path in (entry.onnx, entry.spec):
        if path not in _known:
            _known[path] = sha256(path)
    return [_known[entry.onnx], _known[entry.spec]]


def timed_build(runs: Path, site: Path, root: Path) -> tuple[Built, float, float]:
    begun, cpu = time.perf_counter(), time.process_time()
    built = build(find_runs([runs]), site, Options(root))
    return built, time.perf_counter() - begun, time.process_time() - cpu


def front_page_time(site: Path) -> Iterator[tuple[str, float]]:
    """Yield for some pages how long (s) until their scripts have run, in Chromium."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 (a test's need)

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        for name in ("index.html", "plots.html", "instances.html"):
            page = chromium.new_page()
            page.goto((site / name).as_uri())
            script = "performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd"
            yield name, page.evaluate(script) / 1000
        chromium.close()


def folder_size(site: Path, *patterns: str) -> int:
    return sum(p.stat().st_size for pattern in patterns for p in site.glob(pattern) if p.is_file())


@click.command()
@click.option("--tools", default=20, show_default=True)
@click.option("--instances", default=6000, show_default=True)
@click.option("--keep", type=click.Path(path_type=Path), help="Keep everything in this folder.")
@click.option("--no-browser", is_flag=True)
def main(tools: int, instances: int, keep: Path | None, no_browser: bool) -> None:
    folder = keep or Path(tempfile.mkdtemp())
    runs, root, site = folder / "runs", folder / "set" / "benchmarks", folder / "site"
    if not runs.exists():
        entries = write_instances(root, instances)
        for i in range(tools):
            write_run(runs / f"tool-{i:02}", f"tool-{i:02}", i, root, entries)
    begun, cpu = time.perf_counter(), time.process_time()
    count = sum(len(run.records()) for run in find_runs([runs]))
    took, reading = time.perf_counter() - begun, time.process_time() - cpu
    print(f"{tools} tools, {instances} instances, {count} results")
    print(f"reading alone: {took:.1f} s, CPU {reading:.1f} s")
    shutil.rmtree(site, ignore_errors=True)
    for what in ("from nothing", "nothing changed"):
        built, took, cpu = timed_build(runs, site, root)
        print(f"{what}: {took:.1f} s, CPU {cpu:.1f} s ({cpu / reading:.1f} times reading), "
              f"{built.written} files written, {built.kept} kept")  # fmt: skip
    for what, patterns in PARTS.items():
        print(f"{what}: {folder_size(site, *patterns):,} bytes")
    if not no_browser:
        for name, seconds in front_page_time(site):
            print(f"{name}: scripts have run after {seconds:.2f} s")
    if keep is None:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()

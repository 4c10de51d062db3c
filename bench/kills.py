"""Kill runs at random instants, again and again, and count what they hold in the end.

    python -m bench.kills [--dask] [--kills N] [--instances N] [--jobs N] [--every N] [--seed N]

A fake tool answers at once. ``harness run --resume`` is killed (SIGKILL) at a random instant
and started again, until the run is complete; then another run begins, until there were so many
kills. One in five comes within two seconds after the last, whatever is done by then; the others
after up to 2 N new results (--every N), and a moment.

With --dask the instances run on two workers of a scheduler of its own, and the victim is the
harness, a worker or, more rarely, the scheduler; what was killed is started again.

After every kill: what had been stored is there, unchanged. After every run: each instance has
exactly one record, with the answer, log, witness and check that belong to it, and no instance
was started again after it had been stored. Ends with status 1 at the first fault.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from harness.records import Record, Verdict
from harness.store import RunFolder

QUICK = Path(__file__).resolve().parents[1] / "benchmarks" / "quick" / "json"
#: Every so many instances the tool says sat, with a witness, so that there is a check to store.
SAT_EVERY = 50
#: How long (seconds) a victim may take to get on.
PATIENCE_S = 600.0
#: A kill soon after the start comes within this time (s), one later this much after a result.
SOON_S, MOMENT_S = 2.0, 0.1
RUN = """
ID=$(basename "$4" .json)
echo "$ID" >> {starts}
echo "output of $ID"
case $ID in
  *sat) printf 'sat\\n{{"s": 0.7, "f": 9.9, "v": 0, "theta": 0}}\\n' > "$5" ;;
  *) echo unsat > "$5" ;;
esac
"""


class Fault(Exception):
    """What must not happen; the message says what."""


@dataclass
class Setup:
    """A benchmarks folder of copies of one instance, and a tool that answers at once."""

    folder: Path
    count: int

    def __post_init__(self) -> None:
        spec = min(QUICK.iterdir())
        data = json.loads(spec.read_text())
        onnx = (spec.parent / data["controller"]["file"]).resolve()
        category = self.folder / "benchmarks" / "fake"
        (category / "json").mkdir(parents=True)
        (self.folder / "onnx").mkdir()
        (self.folder / "onnx" / onnx.name).write_bytes(onnx.read_bytes())
        data["category"] = "fake"
        data["controller"]["file"] = f"../../../onnx/{onnx.name}"
        rows = []
        for name in self.names:
            text = json.dumps({**data, "id": name})
            (category / "json" / f"{name}.json").write_text(text)
            rows.append(f"../../onnx/{onnx.name},json/{name}.json,20\n")
        (category / "instances.csv").write_text("".join(rows))
        self.tool.mkdir()
        (self.tool / "prepare_instance.sh").write_text("true\n")
        (self.tool / "run_instance.sh").write_text(RUN.format(starts=self.starts))

    @property
    def names(self) -> list[str]:
        """IDs of the instances; those that end with sat are answered so."""
        return [f"i{i:05d}{'' if i % SAT_EVERY else 'sat'}" for i in range(self.count)]

    @property
    def tool(self) -> Path:
        return self.folder / "tool"

    @property
    def starts(self) -> Path:
        """A file with a line for every start of an instance."""
        return self.folder / "starts"

    def command(self, out: Path, options: Sequence[str]) -> list[str]:
        return [
            *(sys.executable, "-m", "harness", "run", "--tool", str(self.tool), "--resume"),
            *("--benchmarks", str(self.folder / "benchmarks"), "--out", str(out), *options),
        ]


@dataclass
class Tally:
    """What was counted, over all runs."""

    kills: Counter[str] = field(default_factory=Counter)
    runs: int = 0
    instances: int = 0
    starts: int = 0

    @property
    def total(self) -> int:
        return self.kills.total()


def begin(command: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    with log.open("ab") as output:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=output
        )


def kill(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()


class Nothing:
    """No victims beside the harness."""

    options: tuple[str, ...] = ()

    def restart(self) -> None:
        pass

    def kill_one(self, rng: random.Random) -> str | None:
        return None


class Cluster:
    """A Dask scheduler and two workers, each a process."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = probe.getsockname()[1]
        self._folder = folder
        self.scheduler = self.start_scheduler()
        give_up = time.monotonic() + PATIENCE_S
        while not self._answers() and time.monotonic() < give_up:
            time.sleep(0.05)
        self.workers = [self._start_worker() for _ in range(2)]

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self._port}"

    @property
    def options(self) -> tuple[str, ...]:
        return ("--scheduler", self.address)

    def _answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self._port)) == 0

    def start_scheduler(self) -> subprocess.Popen[bytes]:
        where = ("--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard")
        command = [sys.executable, "-m", "dask", "scheduler", *where]
        return begin(command, self._folder / "scheduler.log")

    def _start_worker(self) -> subprocess.Popen[bytes]:
        command = [
            *(sys.executable, "-m", "dask", "worker", self.address, "--host", "127.0.0.1"),
            *("--nthreads", "1", "--no-nanny", "--no-dashboard"),
            *("--local-directory", str(self._folder)),
        ]
        return begin(command, self._folder / "workers.log")

    def kill_one(self, rng: random.Random) -> str | None:
        """Kill a worker or the scheduler, or nothing: then the harness is the victim."""
        victim = rng.choices(("harness", "worker", "scheduler"), (5, 4, 1))[0]
        if victim == "harness":
            return None
        if victim == "scheduler":
            kill(self.scheduler)
            self.scheduler = self.start_scheduler()
        else:
            kill(rng.choice(self.workers))
        self.restart()
        return victim

    def restart(self) -> None:
        """Start workers in the place of those that ended, as a batch system would."""
        self.workers = [
            worker if worker.poll() is None else self._start_worker() for worker in self.workers
        ]

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            with suppress(OSError):
                kill(process)


def stored(out: Path) -> dict[str, Record]:
    if not out.exists():
        return {}
    with RunFolder.open(out) as folder:
        return {record.instance: record for record in folder.records()}


def run_once(
    setup: Setup, out: Path, victims: Nothing | Cluster, options: Sequence[str],
    rng: random.Random, tally: Tally, most: int, every: int,
) -> None:  # fmt: skip
    """Complete one run, with kills as long as there are fewer than ``most``."""
    setup.starts.write_text("")
    errors = setup.folder / "errors"
    command = setup.command(out, [*options, *victims.options])
    before: dict[str, Record] = {}
    once: Counter[str] = Counter()
    process = begin(command, errors)
    try:
        while tally.total < most and live(process, out, victims, rng, every):
            victim = victims.kill_one(rng)
            if victim is None:
                kill(process)
                process = begin(command, errors)
            tally.kills[victim or "harness"] += 1
            now = stored(out)
            if not before.items() <= now.items():
                raise Fault(f"{out}: a result was lost or changed")
            counts = starts_of(setup)
            for name in now.keys() - before.keys():
                once[name] = counts[name]
            before = now
        give_up = time.monotonic() + PATIENCE_S
        while not ends_within(process, 0.1):
            victims.restart()
            if time.monotonic() > give_up:
                raise Fault(f"{out}: not complete after {PATIENCE_S:g} s without a kill")
    finally:
        if process.poll() is None:
            kill(process)
    if process.returncode != 0:
        raise Fault(f"{out}: status {process.returncode}: {errors.read_text()[-2000:]}")
    check(setup, out, once)
    tally.runs += 1
    tally.instances += setup.count
    tally.starts += starts_of(setup).total()


def live(
    process: subprocess.Popen[bytes], out: Path, victims: Nothing | Cluster,
    rng: random.Random, every: int,
) -> bool:  # fmt: skip
    """Let a harness live for a random while; return whether it still does."""
    if rng.random() < 0.2:
        return not ends_within(process, rng.uniform(0, SOON_S))
    goal, give_up = len(stored(out)) + rng.randint(1, 2 * every), time.monotonic() + PATIENCE_S
    while len(stored(out)) < goal:
        victims.restart()
        if ends_within(process, 0.1):
            return False
        if time.monotonic() > give_up:
            raise Fault(f"{out}: nothing new for {PATIENCE_S:g} s without a kill")
    return not ends_within(process, rng.uniform(0, MOMENT_S))


def ends_within(process: subprocess.Popen[bytes], seconds: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        process.wait(seconds)
        return True
    return False


def starts_of(setup: Setup) -> Counter[str]:
    return Counter(setup.starts.read_text().split())


def check(setup: Setup, out: Path, once: Counter[str]) -> None:
    """Raise Fault unless a complete run holds what it must.

    once: how often each instance had been started when it was first seen to be stored.
    """
    results = [line.split(",") for line in (out / "results.csv").read_text().splitlines()]
    with RunFolder.open(out) as folder:
        records = folder.records()
        if [record.instance for record in records] != sorted(setup.names):
            raise Fault(f"{out}: {len(records)} records of {setup.count} instances")
        for record in records:
            sat = record.instance.endswith("sat")
            verdict = Verdict.SAT if sat else Verdict.UNSAT
            if record.verdict is not verdict:
                raise Fault(f"{out}: {record.instance} is {record.result}, {record.detail}")
            if folder.log(record) != f"output of {record.instance}\n".encode():
                raise Fault(f"{out}: {record.instance} has another log")
            if bool(folder.witness(record)) != sat or bool(folder.check(record.instance)) != sat:
                raise Fault(f"{out}: {record.instance} lacks its witness or check, or has one")
    if len(results) != setup.count or {len(row) for row in results} != {6}:
        raise Fault(f"{out}: results.csv has {len(results)} rows")
    counts = starts_of(setup)
    again = [name for name, count in once.items() if counts[name] != count]
    if again:
        raise Fault(f"{out}: {again} were run again after they had been stored")


@contextmanager
def victims_of(dask: bool, folder: Path) -> Iterator[Nothing | Cluster]:
    if not dask:
        yield Nothing()
        return
    cluster = Cluster(folder)
    try:
        yield cluster
    finally:
        cluster.close()


def storm(dask: bool, kills: int, count: int, jobs: int, every: int, seed: int) -> Tally:
    """Kill and go on until there were so many kills; raise Fault for what must not happen."""
    rng, tally = random.Random(seed), Tally()
    options = [] if dask else ["--jobs", str(jobs)]
    with tempfile.TemporaryDirectory() as name, victims_of(dask, Path(name)) as victims:
        setup = Setup(Path(name), count)
        while tally.total < kills:
            out = setup.folder / f"run{tally.runs}"
            run_once(setup, out, victims, options, rng, tally, kills, every)
    return tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--dask", action="store_true")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--instances", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--every", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ["PYTHONWARNINGS"] = "ignore"
    start = time.monotonic()
    try:
        tally = storm(
            options.dask,
            options.kills,
            options.instances,
            options.jobs,
            options.every,
            options.seed,
        )
    except Fault as fault:
        sys.exit(f"FAULT: {fault}")
    victims = ", ".join(f"{count} of the {name}" for name, count in tally.kills.most_common())
    print(f"{tally.total} kills ({victims}) in {time.monotonic() - start:.0f} s")
    print(
        f"{tally.runs} runs, {tally.instances} instances, each with exactly one record; "
        f"{tally.starts - tally.instances} were started again, none that had been stored"
    )


if __name__ == "__main__":
    main()

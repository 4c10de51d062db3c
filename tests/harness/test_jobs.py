"""``harness run --jobs``: several instances at a time, each on its own cores."""

import json
import os
import signal
import subprocess
import sys

import pytest
from harness_helpers import carriers, harness, wait_until

from harness.store import RunFolder

CORES = sorted(os.sched_getaffinity(0))
needs_two = pytest.mark.skipif(len(CORES) < 2, reason="there is one core only")


@pytest.fixture
def command(benchmarks, tmp_path):
    def make(tool, *options):
        where = ("--benchmarks", benchmarks.root, "--out", tmp_path / "run")
        return ["run", "--tool", tool, *where, *options]

    return make


@needs_two
def test_two_run_at_a_time_each_on_its_own_core(benchmarks, make_tool, command, tmp_path):
    for i in range(6):
        benchmarks.add(f"i{i}")
    # Each waits until another one is there: alone, none would come to an end.
    tool = make_tool(
        f"""
        touch {tmp_path}/here-$ID
        while [ "$(ls {tmp_path} | grep -c here-)" -lt 2 ]; do sleep 0.01; done
        grep Cpus_allowed_list /proc/self/status
        sleep 0.05; rm -f {tmp_path}/here-$ID.done
        echo unsat > "$RESULTS"
        """
    )
    done = harness(*command(tool, "--jobs", "2", "--json"))
    assert done.returncode == 0, done.stderr
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert {r["instance"]: r["result"] for r in results} == {f"i{i}": "unsat" for i in range(6)}
    with RunFolder.open(tmp_path / "run") as folder:
        lists = {folder.log(record).split()[-1] for record in folder.records()}
    assert len(lists) == 2
    shares = [set(numbers(text.decode())) for text in lists]
    assert not shares[0] & shares[1]
    assert {len(share) for share in shares} == {len(CORES) // 2}
    assert sorted(os.sched_getaffinity(0)) == CORES  # the harness itself is not pinned


def numbers(text):
    """Read a list of cores as /proc writes it: 0-2,5."""
    for part in text.split(","):
        first, _, last = part.partition("-")
        yield from range(int(first), int(last or first) + 1)


def test_cores_per_job(benchmarks, make_tool, command, tmp_path):
    benchmarks.add("one")
    tool = make_tool('grep Cpus_allowed_list /proc/self/status; echo unsat > "$RESULTS"')
    assert harness(*command(tool, "--cores-per-job", "1")).returncode == 0
    with RunFolder.open(tmp_path / "run") as folder:
        log = folder.log(folder.record("one")).decode()
    assert len(list(numbers(log.split()[-1]))) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--jobs", "100000"], "100000 jobs at a time: only"),
        (["--jobs", "1", "--cores-per-job", "100000"], "with 100000 cores each: only"),
        (["--jobs", "0"], "--jobs"),
        (["--jobs", "2", "--scheduler", "tcp://127.0.0.1:9"], "the workers say how many"),
    ],
)
def test_more_than_there_is_is_refused(benchmarks, make_tool, command, tmp_path, options, message):
    benchmarks.add("one")
    done = harness(*command(make_tool('echo unsat > "$RESULTS"'), *options))
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()


@needs_two
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_ends_all_tools_and_says_how_to_go_on(
    benchmarks, make_tool, command, marker, tmp_path, number
):
    for name in ("quick0", "slow1", "slow2", "slow3"):
        benchmarks.add(name, timeout=500)
    started = tmp_path / "started"
    tool = make_tool(
        f"""
        echo $ID >> {started}
        case $ID in slow*) [ -e {tmp_path}/again ] || sleep 1000 ;; esac
        echo unsat > "$RESULTS"
        """
    )
    arguments = command(tool, "--jobs", "2")
    process = subprocess.Popen(
        [sys.executable, "-m", "harness", *map(str, arguments)],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    wait_until(lambda: started.exists() and len(started.read_text().split()) == 3, 60)
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert carriers(marker) == []
    assert errors.startswith("to go on: harness run --tool ")
    with RunFolder.open(tmp_path / "run") as folder:
        assert folder.instances() == {"quick0"}
    (tmp_path / "again").touch()
    assert harness(*arguments, "--resume").returncode == 0
    with RunFolder.open(tmp_path / "run") as folder:
        assert len(folder.records()) == 4


def test_a_failure_of_one_job_ends_the_others(benchmarks, make_tool, command, marker, tmp_path):
    """The instance that is not what it was when the run began stops the run in one line."""
    for i in range(4):
        benchmarks.add(f"i{i}", (0.25, 0.5), timeout=500)
    spec = benchmarks.root / "quick" / "json" / "i0.json"
    tool = make_tool(
        f"""
        [ $ID = i1 ] && sleep 1000
        echo >> {spec}
        printf 'sat\\n{{"s": 0.28, "f": 9.9, "v": 0, "theta": 0}}\\n' > "$RESULTS"
        """
    )
    done = harness(*command(tool, *(["--jobs", "2"] if len(CORES) > 1 else [])))
    assert done.returncode == 2
    assert "not the one that fake was given" in done.stderr
    assert carriers(marker) == []


def test_a_full_disk_is_not_the_tools_fault(benchmarks, make_tool, command, monkeypatch, tmp_path):
    benchmarks.add("one")
    tool = make_tool('echo unsat > "$RESULTS"')
    monkeypatch.setattr("harness.job.LEAST_ROOM", 1 << 80)
    done = harness(*command(tool))
    assert done.returncode == 2
    assert "the disk is full, and tools have no room for scratch" in done.stderr
    monkeypatch.undo()
    assert harness(*command(tool, "--resume")).returncode == 0

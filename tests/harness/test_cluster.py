"""``harness run --scheduler``: a real Dask scheduler with two workers, any of which may be lost."""

import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import psutil
import pytest
from harness_helpers import harness, wait_until

from bench.kills import Cluster, kill
from harness.store import RunFolder

pytest.importorskip("distributed")
#: What is to happen does so within seconds, on a machine that has nothing else to do.
SOON_S = 120.0
SAT = """printf 'sat\\n{"s": 0.28, "f": 9.9, "v": 0, "theta": 0}\\n' > "$RESULTS" """


@pytest.fixture
def start_cluster():
    """Return a function that starts a scheduler and two workers, with variables set for them."""
    clusters = []

    def start(**variables):
        with tempfile.TemporaryDirectory() as name:
            before = dict(os.environ)
            os.environ.update(variables)
            try:
                clusters.append(Cluster(Path(name)))
            finally:
                os.environ.clear()
                os.environ.update(before)
        return clusters[-1]

    yield start
    for cluster in clusters:
        cluster.close()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A cluster that several tests use; what they kill is started again."""
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.close()


@pytest.fixture
def run(benchmarks, tmp_path):
    """Return a function that gives the command for a run of the benchmarks on a cluster."""

    def make(cluster, tool, *options):
        where = ("--benchmarks", benchmarks.root, "--out", tmp_path / "run")
        return ["run", "--tool", tool, *where, *cluster.options, *options]

    return make


@pytest.fixture
def begin():
    """Return a function that starts a harness as a process; what is left is killed."""
    started = []

    def start(arguments):
        command = [sys.executable, "-m", "harness", *map(str, arguments)]
        streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        started.append(subprocess.Popen(command, text=True, **streams))
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            kill(process)


def records(tmp_path):
    with RunFolder(tmp_path / "run") as folder:
        return {record.instance: record for record in folder.records()}


def naps(seconds):
    """Return how many processes sleep just so long."""
    found = 0
    for process in psutil.process_iter():
        try:
            found += process.cmdline() == ["sleep", seconds]
        except psutil.Error:
            continue
    return found


def test_results_are_the_same_as_here(cluster, benchmarks, make_tool, run, tmp_path):
    for name in ("sat_right", "unsat", "exits"):
        benchmarks.add(name, (0.25, 0.5))
    tool = make_tool(
        f"""
        echo "output of $ID"
        grep Cpus_allowed_list /proc/self/status >> {tmp_path}/cores
        case $ID in
          sat_right) {SAT} ;;
          unsat) echo unsat > "$RESULTS" ;;
          exits) exit 3 ;;
        esac
        """,
        install=f'echo "$@" >> {tmp_path}/installed',
    )
    done = harness(*run(cluster, tool, "--json", "--cores-per-job", "1"))
    assert done.returncode == 0, done.stderr
    there = {r["instance"]: r for r in map(json.loads, done.stdout.splitlines())}
    assert (tmp_path / "installed").read_text() == "v1\n"
    local = harness("run", "--tool", tool, "--benchmarks", benchmarks.root, "--json",
                    "--out", tmp_path / "local")  # fmt: skip
    here = {r["instance"]: r for r in map(json.loads, local.stdout.splitlines())}
    measured = {"started_at", "prepare_time", "run_time", "cpu_time", "max_memory_mib", "command"}
    for name, result in here.items():
        for key in measured:
            del result[key], there[name][key]
        result["limits"].pop("cores", None), there[name]["limits"].pop("cores", None)
    assert there == here
    assert there["sat_right"]["witness_check"]["outcome"] == "correct"
    with RunFolder.open(tmp_path / "run") as folder:
        assert folder.log(folder.record("unsat")).startswith(b"output of unsat\n")
        assert set(folder.info().workers) == {platform.node()}
    (allowed,) = {line.split()[-1] for line in (tmp_path / "cores").read_text().splitlines()[:3]}
    assert allowed.isdecimal()  # one core


def test_a_worker_may_be_lost(cluster, benchmarks, make_tool, run, begin, tmp_path):
    for i in range(8):
        benchmarks.add(f"i{i}")
    starts = tmp_path / "starts"
    tool = make_tool(f'echo $ID >> {starts}; sleep 0.3; echo unsat > "$RESULTS"')
    process = begin(run(cluster, tool))
    wait_until(lambda: len(records(tmp_path)) >= 2, SOON_S)
    before = records(tmp_path)
    kill(cluster.workers[0])
    _, errors = process.communicate(timeout=SOON_S)
    cluster.restart()
    assert process.returncode == 0, errors
    after = records(tmp_path)
    assert {name: r.result for name, r in after.items()} == {f"i{i}": "unsat" for i in range(8)}
    assert before.items() <= after.items()
    counts = starts.read_text().split()
    assert 8 <= len(counts) <= 10  # what the worker had begun, and one that waited there
    assert all(counts.count(name) == 1 for name in before)


def test_the_harness_may_be_lost(cluster, benchmarks, make_tool, run, begin, tmp_path):
    for i in range(3):
        benchmarks.add(f"i{i}", timeout=5000)
    fast = tmp_path / "fast"
    tool = make_tool(f'[ $ID = i0 ] || [ -e {fast} ] || sleep 4321; echo unsat > "$RESULTS"')
    arguments = run(cluster, tool)
    for number, status in ((signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130)):
        process = begin(arguments)
        wait_until(lambda: naps("4321") == 2 and "i0" in records(tmp_path), SOON_S)
        process.send_signal(number)
        _, errors = process.communicate(timeout=SOON_S)
        assert process.returncode == status
        wait_until(lambda: naps("4321") == 0, SOON_S)  # the tools are ended on the workers
        assert set(records(tmp_path)) == {"i0"}
        arguments = run(cluster, tool, "--resume")
    first, *_, last = errors.splitlines()
    assert first.startswith("to go on: harness run")
    assert last == "interrupted"
    fast.touch()
    assert harness(*arguments).returncode == 0
    assert len(records(tmp_path)) == 3


def test_files_that_differ_are_refused(cluster, benchmarks, make_tool, run):
    specs = [benchmarks.add(f"i{i}") for i in range(6)]
    tool = make_tool(f'echo >> {specs[5]}; sleep 0.1; echo unsat > "$RESULTS"')
    done = harness(*run(cluster, tool))
    assert done.returncode == 2
    assert f"{specs[5]} is another file than where the harness runs" in done.stderr
    assert done.stderr.count("\n") == 1


def test_more_cores_than_a_worker_has_are_refused(cluster, benchmarks, make_tool, run):
    benchmarks.add("one")
    done = harness(*run(cluster, make_tool("true"), "--cores-per-job", "9999"))
    assert done.returncode == 2
    assert "1 jobs at a time with 9999 cores each: only" in done.stderr
    assert "dask worker --nthreads" in done.stderr


def test_the_scheduler_may_be_lost(start_cluster, benchmarks, make_tool, run, begin, tmp_path):
    cluster = start_cluster()
    for i in range(6):
        benchmarks.add(f"i{i}", timeout=5000)
    fast = tmp_path / "fast"
    tool = make_tool(f'[ $ID = i0 ] || [ -e {fast} ] || sleep 5432; echo unsat > "$RESULTS"')
    process = begin(run(cluster, tool))
    wait_until(lambda: naps("5432") == 2, SOON_S)
    kill(cluster.scheduler)
    wait_until(lambda: naps("5432") == 0, SOON_S)  # the workers end, and the tools with them
    fast.touch()
    cluster.close()
    cluster.scheduler = cluster.start_scheduler()
    cluster.restart()
    _, errors = process.communicate(timeout=SOON_S)
    assert process.returncode == 0, errors
    assert errors == ""
    results = records(tmp_path)
    assert {name: r.result for name, r in results.items()} == {f"i{i}": "unsat" for i in range(6)}


def test_an_instance_that_costs_worker_after_worker_is_an_error(
    start_cluster, benchmarks, make_tool, run, begin, tmp_path
):
    cluster = start_cluster(DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0")
    for name in ("good", "kills"):
        benchmarks.add(name)
    worker = tmp_path / "worker"
    tool = make_tool(
        f"""
        parent() {{ cut -d' ' -f4 "/proc/$1/stat"; }}
        if [ $ID = kills ]; then
          pid=$$
          until grep -q dask "/proc/$pid/cmdline"; do pid=$(parent $pid); done
          echo $pid > {worker}.part; mv {worker}.part {worker}; sleep 1000
        fi
        sleep 0.3; echo unsat > "$RESULTS"
        """
    )
    process = begin(run(cluster, tool))
    wait_until(worker.exists, SOON_S)
    # From here: where the system allows it, a tool is kept from sending signals to others.
    os.kill(int(worker.read_text()), signal.SIGKILL)
    _, errors = process.communicate(timeout=SOON_S)
    assert process.returncode == 0, errors
    results = records(tmp_path)
    assert results["good"].result == "unsat"
    assert results["kills"].result == "error"
    assert results["kills"].detail == "its worker was lost 1 times while it ran"


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "nowhere://x:1"])
def test_no_scheduler_is_one_line(benchmarks, make_tool, monkeypatch, tmp_path, address):
    monkeypatch.setattr("harness.cluster.CONNECT_S", 0.3)
    benchmarks.add("one")
    where = ("--benchmarks", benchmarks.root, "--out", tmp_path / "run")
    done = harness("run", "--tool", make_tool("true"), *where, "--scheduler", address)
    assert done.returncode == 2
    assert f"--scheduler {address}: no Dask scheduler answers there" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()

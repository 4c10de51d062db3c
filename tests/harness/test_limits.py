"""Each limit of a tool: that it is kept, for all of its processes, and said to be."""

import os
import threading
from pathlib import Path

import psutil
import pytest
from harness_helpers import BOTH, KILLED, SOON, TIMEOUT, harness, wait_until

from harness.catalogue import select
from harness.limits import Allowance
from harness.runner import Runner
from harness.store import RunFolder
from harness.supervisor import Supervisor
from harness.tool import find_tool
from racecar.errors import BadInput

SPIN = {
    "sessions": "for i in 1 2; do setsid -f bash -c 'while :; do :; done'; done; sleep 1000",
    # The time of children that nobody waits for is added to nobody's.
    "one after another": """exec "$PYTHON" -c '
import os, signal, time
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
while True:
    if os.fork() == 0:
        while time.process_time() < 0.15: pass
        os._exit(0)
    try: os.wait()
    except ChildProcessError: pass'""",
}


@BOTH
@pytest.mark.parametrize("spin", SPIN.values(), ids=SPIN)
def test_cpu_time_of_all_processes_is_limited(make_runner, cgroups, spin):
    limits = Allowance(cpu_s=0.4, cgroups=cgroups)
    runner, entry = make_runner(spin, limits=limits)
    record = runner.run(entry).record
    assert record.result == TIMEOUT
    assert record.detail == "it used more than the limit of 0.4 s of CPU time"
    assert 0.4 < record.cpu_time < SOON
    assert record.run_time < SOON
    assert (record.limits.cpu_s.asked, record.limits.cpu_s.kept) == (0.4, 0.4)
    assert record.limits.cpu_s.by == record.measured_by.cpu_time


@BOTH
def test_answer_after_too_much_cpu_time_does_not_count(make_runner, cgroups):
    # It sleeps through no look: too short for one, but its own time tells in the end.
    spin = 'for i in {1..30000}; do :; done; echo unsat > "$RESULTS"'
    runner, entry = make_runner(spin, limits=Allowance(cpu_s=0.005, cgroups=cgroups))
    assert runner.run(entry).record.result == TIMEOUT


@BOTH
def test_memory_is_that_of_all_processes(make_runner, cgroups):
    run = (
        'for i in 1 2 3; do "$PYTHON" -c "import time; x = bytearray(b\'x\') * (60 << 20)\n'
        'time.sleep(0.6)" & done; wait; echo unsat > "$RESULTS"'
    )
    runner, entry = make_runner(run, limits=Allowance(cgroups=cgroups))
    record = runner.run(entry).record
    assert record.result == "unsat"
    assert 180 < record.max_memory_mib < 300
    assert record.limits.memory_mib.asked is None


@BOTH
def test_shared_memory_counts_once(make_runner, cgroups):
    run = """exec "$PYTHON" -c '
import os, time
x = bytearray(b"x") * (150 << 20)
children = [os.fork() for _ in range(1)]
if 0 not in children:
    children.append(os.fork())
time.sleep(0.5)
if 0 not in children:
    for pid in children: os.waitpid(pid, 0)
    open(os.environ["RESULTS"], "w").write("unsat")'"""
    limits = Allowance(memory_mib=300, cgroups=cgroups)
    runner, entry = make_runner(f"export RESULTS; {run}", limits=limits)
    record = runner.run(entry).record
    assert record.result == "unsat"
    assert 150 < record.max_memory_mib < 250


@BOTH
def test_tool_is_pinned_to_its_cores(make_runner, cgroups):
    core = max(os.sched_getaffinity(0))
    run = '"$PYTHON" -c "import os; print(os.sched_getaffinity(0))"; echo unsat > "$RESULTS"'
    runner, entry = make_runner(run, cores=[core], limits=Allowance(cgroups=cgroups))
    finished = runner.run(entry)
    assert finished.log.decode().strip() == f"{{{core}}}"
    assert finished.record.limits.cores.kept == [core]
    assert finished.record.limits.cores.by in ("cpuset", "affinity")


def test_cores_that_are_not_there_are_refused(make_runner):
    with pytest.raises(BadInput, match="cores 0, 4096: usable are "):
        make_runner("", cores=[0, 4096])


def test_limits_hold_in_prepare_instance_too(make_runner):
    runner, entry = make_runner("", prepare="yes", limits=Allowance(output_mib=1))
    record = runner.run(entry).record
    assert record.result == "prepare_instance_error_137"
    assert record.detail.startswith("prepare_instance.sh used more than the limit of 1 MiB of p")


def test_result_of_a_gigabyte_is_ended_by_default(make_runner):
    # Sparse, so that the disk is spared; a whole one is among the deeds above.
    run = 'echo unsat > "$RESULTS"; truncate -s 1100M "$RESULTS"; sleep 1000'
    runner, entry = make_runner(run)
    record = runner.run(entry).record
    assert record.result == KILLED
    assert (record.limits.output_mib.asked, record.limits.output_mib.kept) == (None, 1024)


def test_a_fresh_home_and_temporary_folders_lie_in_scratch(make_runner, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    show = 'printf "%s\\n" "$HOME" "$TMPDIR" "$TMP" "${XDG_CACHE_HOME-}"; ls -A "$HOME" "$TMPDIR"'
    runner, entry = make_runner(show, limits=Allowance(fresh_home=True))
    finished = runner.run(entry)
    home, *others = finished.log.decode().splitlines()
    temporary = [str(Path(home).with_name("tmp"))] * 2
    assert others == [*temporary, "", f"{home}:", "", f"{temporary[0]}:"]
    assert finished.record.limits.home == "fresh"
    runner.close()
    assert not Path(home).exists()


def test_home_is_the_users_own_by_default(make_runner):
    runner, entry = make_runner('echo "$HOME"')
    finished = runner.run(entry)
    assert finished.log.decode().strip() == os.environ["HOME"]
    assert finished.record.limits.home == "own"


def test_several_runners_at_once(benchmarks, make_tool, temporary, marker):
    names = [f"i{i}" for i in range(4)]
    for name in names:
        benchmarks.add(name, (0.25, 0.5), timeout=0.5)
    deed = (
        'case $ID in i0|i2) sleep 1000 ;; *) setsid -f sleep 1000; echo unsat > "$RESULTS" ;; esac'
    )
    tool = find_tool(str(make_tool(deed)))
    entries = select(benchmarks.root, ("quick",), ())
    records = {}

    def work(entry):
        with Runner(tool, benchmarks.root) as runner:
            records[entry.id] = runner.run(entry).record

    threads = [threading.Thread(target=work, args=(entry,)) for entry in entries]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {name: r.result for name, r in records.items()} == dict(
        zip(names, [TIMEOUT, "unsat", TIMEOUT, "unsat"], strict=True)
    )


def test_closing_takes_no_group_along(temporary):
    before = groups()
    with Supervisor():
        pass
    wait_until(lambda: groups() <= before)


def groups():
    """Return the control groups that were made by keepers which are gone."""
    found = set()
    for mount in psutil.disk_partitions(all=True):
        if mount.fstype in ("cgroup", "cgroup2"):
            for path in Path(mount.mountpoint).rglob("closedlap_*_*"):
                if not psutil.pid_exists(int(path.name.split("_")[1])):
                    found.add(path)
    return found


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--memory-limit", "much"], "'much' is not a size; write 4096 (MiB), 16GB or 512MiB"),
        (["--memory-limit", "0"], "'0' is too small or too large for a limit"),
        (["--memory-limit", "-3"], "'-3' is not a size"),
        (["--scratch-limit", "1e400"], "is not a size"),
        (["--cpu-limit", "0"], "--cpu-limit"),
        (["--cpu-limit", "nan"], "--cpu-limit"),
    ],
)
def test_limits_that_are_none_are_refused(arguments, message):
    done = harness("run", "--tool", "simulate", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_sizes_have_units(benchmarks, make_tool, tmp_path, temporary):
    benchmarks.add("one", (0.25, 0.5))
    tool, out = make_tool('echo unsat > "$RESULTS"'), tmp_path / "run"
    sizes = ("--memory-limit", "2GB", "--output-limit", "0.5GiB", "--scratch-limit", "64")
    arguments = ("--tool", tool, "--benchmarks", benchmarks.root, "--out", out)
    assert harness("run", *arguments, *sizes).returncode == 0
    with RunFolder.open(out) as run:
        limits = run.record("one").limits
    assert limits.memory_mib.kept == pytest.approx(2e9 / 2**20)
    assert (limits.output_mib.kept, limits.scratch_mib.kept) == (512, 64)
    # A run is continued with the limits that it was begun with, or not at all.
    assert harness("run", *arguments, *sizes, "--resume").returncode == 0
    done = harness("run", *arguments, *sizes[:4], "--scratch-limit", "65", "--resume")
    assert done.returncode == 2
    assert "begun with another --scratch-limit (MiB) (64.0, now 65.0)" in done.stderr


def test_a_wall_limit_is_kept_while_scratch_is_looked_at(make_runner):
    # Thousands of files: a look takes long, and must not hold up the end.
    run = "mkdir a; cd a; for i in {1..3000}; do : > $i; done; sleep 1000"
    runner, entry = make_runner(run, timeout=1.0, limits=Allowance(scratch_mib=500))
    record = runner.run(entry).record
    assert record.result == TIMEOUT
    assert 1 < record.run_time < SOON

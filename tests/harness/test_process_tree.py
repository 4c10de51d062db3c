"""Limits hold for everything that a command starts, whatever it does to escape."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from harness_helpers import SOON, carriers, wait_until

from harness import processes
from harness.bounds import WALL, Bounds
from harness.process_tree import GRACE_S
from harness.supervisor import CannotStart, Supervisor


@pytest.fixture(scope="module", params=[True, False], ids=["cgroups", "fallback"])
def shared_supervisor(request):
    """One that uses control groups where they work, and one that does not."""
    with Supervisor(cgroups=request.param) as helper:
        yield helper


@pytest.fixture
def supervisor(shared_supervisor, marker):
    (shared_supervisor.scratch / "log").unlink(missing_ok=True)
    return shared_supervisor


def run(supervisor, script, wall_s=20.0, **bounds):
    log, environment = supervisor.scratch / "log", dict(os.environ)
    command = ["bash", "-c", script]
    return supervisor.run(command, supervisor.scratch, environment, log, Bounds(wall_s, **bounds))


@pytest.mark.parametrize("status", [0, 1, 7, 139])
def test_exit_status_is_reported(supervisor, status):
    outcome = run(supervisor, f"exit {status}")
    assert outcome.exit_code == status
    assert not outcome.timed_out
    assert outcome.survivors == 0


def test_death_by_signal_is_128_and_its_number(supervisor):
    assert run(supervisor, "kill -SEGV $$").exit_code == 128 + signal.SIGSEGV


def test_output_is_kept(supervisor):
    run(supervisor, "echo out; echo err >&2")
    run(supervisor, "echo more")
    assert (supervisor.scratch / "log").read_text() == "out\nerr\nmore\n"


def test_time_and_memory_are_measured(supervisor):
    script = (
        f"{sys.executable} -c 'import time; x = bytearray(64 << 20); t = time.process_time()\n"
        "while time.process_time() < t + 0.5: pass'; sleep 0.3"
    )
    outcome = run(supervisor, script)
    assert 0.5 <= outcome.cpu_s < 2
    assert outcome.wall_s >= 0.8
    assert 64 << 20 <= outcome.max_memory < 256 << 20


STUBBORN = {
    "sleeps": "sleep 1000",
    "ignores signals": "trap '' TERM INT HUP; while :; do sleep 0.05; done",
    "background child": "sleep 1000 & wait",
    "own session": "setsid -w sleep 1000",
    "own session, ignores signals": "setsid -w bash -c 'trap \"\" TERM; sleep 1000; sleep 1000'",
    "many": "for i in {1..60}; do setsid -w sleep 1000 & done; wait",
    "stopped": "kill -STOP $$",
}


@pytest.mark.parametrize("script", STUBBORN.values(), ids=STUBBORN)
def test_limit_is_kept_whatever_the_tool_does(supervisor, marker, script):
    limit = 0.4
    start = time.monotonic()
    outcome = run(supervisor, script, limit)
    wall = time.monotonic() - start
    assert outcome.exceeded == WALL
    assert limit + GRACE_S <= outcome.wall_s <= wall < SOON
    assert outcome.survivors == 0
    assert carriers(marker) == []


LEFTOVERS = {
    "background": "sleep 1000 &",
    "own session": "setsid -f sleep 1000",
    "double fork": "(setsid bash -c 'setsid sleep 1000 & setsid sleep 1000 &' &)",
    "holds output open": "setsid -f bash -c 'trap \"\" TERM; while :; do echo x; sleep 0.02; done'",
    "forks in a loop": "setsid -f bash -c 'trap \"\" TERM; while :; do sleep 9 & sleep 0.01; done'",
}


@pytest.mark.parametrize("script", LEFTOVERS.values(), ids=LEFTOVERS)
def test_what_is_left_behind_is_ended(supervisor, marker, script):
    outcome = run(supervisor, f"{script}\nexit 3")
    assert outcome.exit_code == 3
    assert not outcome.timed_out
    assert outcome.survivors == 0
    assert carriers(marker) == []


def test_process_that_hands_itself_on_is_caught(supervisor, marker):
    # Each process starts the next, in a session of its own, and ends.
    code = (
        "import os,time\n"
        "while True:\n"
        "    time.sleep(0.002)\n"
        "    if os.fork(): os._exit(0)\n"
        "    os.setsid()\n"
    )
    outcome = run(supervisor, f'{sys.executable} -c "{code}"\nexit 0')
    assert outcome.survivors == 0
    assert carriers(marker) == []


def test_both_ways_of_looking_see_the_same_processes(monkeypatch):
    command = ["bash", "-c", "sleep 1000 & (sleep 1000 & sleep 1000) & exec sleep 1000"]
    before = {process.pid for process in processes.descendants()}
    main = subprocess.Popen(command, start_new_session=True)

    def pids():
        return {process.pid for process in processes.descendants()} - before

    try:
        wait_until(lambda: len(pids()) == 5)
        seen = pids()
        monkeypatch.setattr(processes, "_LINUX", False)
        assert pids() == seen
        assert {p.group for p in processes.descendants() if p.pid in seen} == {main.pid}
    finally:
        os.killpg(main.pid, signal.SIGKILL)
        main.wait()


def test_command_that_cannot_start_is_named(supervisor):
    with pytest.raises(CannotStart, match="no-such-program"):
        supervisor.run(
            ["no-such-program"], supervisor.scratch, {}, supervisor.scratch / "log", Bounds(1)
        )
    assert run(supervisor, "exit 5").exit_code == 5


def test_closing_ends_the_tree_and_removes_the_scratch_folder(marker):
    supervisor = Supervisor()
    (supervisor.scratch / "file").write_text("x")
    supervisor.close()
    assert not supervisor.scratch.exists()


def test_killed_harness_leaves_nothing_running(marker, tmp_path):
    script = f"""
import os, sys
from pathlib import Path
from harness.bounds import Bounds
from harness.supervisor import Supervisor
s = Supervisor()
print(s.scratch, flush=True)
tool = "touch {tmp_path}/began; trap '' TERM; setsid -f sleep 99; sleep 99; sleep 99"
s.run(["bash", "-c", tool], s.scratch, dict(os.environ), s.scratch / "log", Bounds(60))
"""
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    scratch = Path(process.stdout.readline().strip())
    wait_until((tmp_path / "began").exists)
    process.kill()
    process.wait()
    process.stdout.close()
    wait_until(lambda: not carriers(marker))
    wait_until(lambda: not scratch.exists())


def test_environment_and_folder_are_those_asked_for(supervisor):
    log = supervisor.scratch / "log"
    code = (
        "import json, os\n"
        "print(json.dumps([os.environ['X'], os.getcwd(), os.getsid(0) == os.getpid()]))"
    )
    command = [sys.executable, "-c", code]
    supervisor.run(command, supervisor.scratch, {"X": "a\udcffb"}, log, Bounds(20))
    assert json.loads(log.read_text()) == ["a\udcffb", str(supervisor.scratch), True]

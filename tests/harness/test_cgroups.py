"""Control groups, where this machine lets us make them."""

import subprocess
import sys

import pytest
from harness_helpers import SOON, wait_until

from harness.cgroups import Cells


@pytest.fixture(scope="module")
def cells():
    # Finding groups may move a process to another one: a process of its own shows whether it would.
    found = subprocess.run(
        [
            sys.executable,
            "-c",
            "from harness.cgroups import Cells; print(Cells.open() is not None)",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    if found.stdout.strip() != "True":
        pytest.skip("no control groups can be made here")
    found = Cells.open()
    yield found
    found.close()


@pytest.fixture
def start(cells):
    """Return a function that starts a script in a cell of its own."""
    started = []

    def start(script, **bounds):
        cell = cells.cell(**bounds)
        process = subprocess.Popen(["bash", "-c", script], preexec_fn=cell.enter)  # noqa: PLW1509
        started.append((cell, process))
        return cell, process

    yield start
    for cell, process in started:
        cell.remove()
        process.wait()


def test_what_forks_in_a_loop_is_killed_at_once(start):
    cell, process = start("while :; do setsid -f sleep 1000; sleep 0.002; done")
    wait_until(lambda: cell.cpu_s() > 0.1)
    cell.kill()
    process.wait(SOON)
    wait_until(lambda: not list(cell._group.get_all_tasks(cell._group.FREEZE)))
    assert process.returncode == -9


def test_memory_is_bounded_and_said_to_be_full(start):
    script = f"{sys.executable} -c 'bytearray(b\"x\") * (200 << 20)'; echo unsat > /dev/null"
    cell, process = start(script, memory=64 << 20)
    process.wait(20)
    assert cell.was_full()
    assert cell.peak() <= 64 << 20
    other, process = start("exit 0", memory=64 << 20)
    process.wait(20)
    assert not other.was_full()


def test_cells_are_apart(start):
    one, first = start("for i in {1..100000}; do :; done")
    two, second = start("exit 0")
    first.wait(20), second.wait(20)
    assert one.cpu_s() > 5 * two.cpu_s() > 0

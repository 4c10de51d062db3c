"""What runs on a Dask worker: one instance, on the cores of one of the worker's threads."""

from __future__ import annotations

import platform
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from distributed import Reschedule, Worker, get_worker
from distributed.core import Status
from distributed.worker import thread_state

from harness.catalogue import Entry, sha256
from harness.cores import share_out, usable_cores
from harness.job import Result, Setting, run_job
from harness.machine import describe_machine
from harness.records import Machine
from harness.runner import Runner, Stopped
from racecar.errors import BadInput

#: How often (seconds) a running task looks whether anybody still waits for it.
POLL_S = 0.25
#: How long (seconds) a runner is kept for the next instance.
IDLE_S = 5.0

_ALIVE = (Status.running, Status.paused, Status.closing_gracefully)
_WANTED = ("executing", "long-running", "resumed")


@dataclass(frozen=True)
class Task:
    """An instance to run, and what the files must be: those that the harness sees.

    scripts_sha256: of the tool's scripts together; cores: how many to be pinned to, default
    the worker's cores divided by its threads; session: a name for the harness process.
    """

    session: str
    setting: Setting
    entry: Entry
    spec_sha256: str
    onnx_sha256: str
    scripts_sha256: str
    cores: int | None


def run_on_worker(task: Task) -> Result:
    """Run an instance; raises BadInput where the worker cannot do what was asked."""
    worker = get_worker()
    _require_same(task)
    with _slot(worker) as slot:
        cores = _cores(worker, task.cores)[slot]
        with _kept_runner(task.session, task.setting, cores) as runner, _watched(runner, worker):
            try:
                result = run_job(runner, task.entry)
            except Stopped:
                # If somebody waits all the same, it is to be run on another worker.
                raise Reschedule from None
    record = result.record
    return Result(record, result.log, result.witness, result.check, _machine())


def install_on_worker(setting: Setting) -> tuple[str | None, bytes]:
    """Run the tool's install_tool.sh; return what is wrong, if anything, and what it printed."""
    with setting.runner() as runner, _watched(runner, get_worker()):
        return runner.install()


def _require_same(task: Task) -> None:
    """Refuse files that are not those which the harness sees."""
    entry, tool = task.entry, task.setting.tool
    for path, known in ((entry.spec, task.spec_sha256), (entry.onnx, task.onnx_sha256)):
        if _sha256(path) != known:
            raise BadInput(f"{_here()}: {path} is another file than where the harness runs")
    if not tool.folder.is_dir():
        raise BadInput(f"{_here()}: there is no tool folder {tool.folder}; is it shared?")
    if tool.info().scripts_sha256 != task.scripts_sha256:
        raise BadInput(f"{_here()}: {tool.folder} holds other scripts than where the harness runs")


def _sha256(path: Path) -> str:
    try:
        return sha256(path)
    except BadInput as error:
        raise BadInput(f"{_here()}: {error}; is its folder shared?") from None


def _here() -> str:
    return f"worker {get_worker().address} on {platform.node()}"


@cache
def _machine() -> Machine:
    return describe_machine()


def _cores(worker: Worker, per_job: int | None) -> list[tuple[int, ...]]:
    """Return the cores of each of the worker's threads."""
    threads = worker.state.nthreads
    try:
        return share_out(threads, per_job, usable_cores())
    except BadInput as error:
        raise BadInput(f"{_here()}: {error} (dask worker --nthreads)") from None


_slots: set[int] = set()
_slots_lock = threading.Lock()


@contextmanager
def _slot(worker: Worker) -> Iterator[int]:
    """Yield a number that no other task on this worker has now, below its number of threads."""
    with _slots_lock:
        slot = min(set(range(worker.state.nthreads)) - _slots)
        _slots.add(slot)
    try:
        yield slot
    finally:
        with _slots_lock:
            _slots.discard(slot)


_idle: dict[tuple[str, Setting, tuple[int, ...]], tuple[Runner, threading.Timer]] = {}
_idle_lock = threading.Lock()


@contextmanager
def _kept_runner(session: str, setting: Setting, cores: tuple[int, ...]) -> Iterator[Runner]:
    """Yield a runner: one that waits for the next instance, as starting one takes time."""
    place = (session, setting, cores)
    with _idle_lock:
        runner, timer = _idle.pop(place, (None, None))
    if timer is not None:
        timer.cancel()
    if runner is None:
        runner = setting.runner(cores=cores)
    try:
        yield runner
    except BaseException:
        runner.close()
        raise
    timer = threading.Timer(IDLE_S, _close_idle, [place, runner])
    timer.daemon = True
    with _idle_lock:
        _idle[place] = runner, timer
    timer.start()


def _close_idle(place: tuple[str, Setting, tuple[int, ...]], runner: Runner) -> None:
    with _idle_lock:
        if _idle.get(place, (None, None))[0] is not runner:
            return
        del _idle[place]
    runner.close()


@contextmanager
def _watched(runner: Runner, worker: Worker) -> Iterator[None]:
    """End the tool as soon as nobody waits for its result any more.

    Dask cannot end a task that runs. It forgets the task when the harness or the scheduler has
    gone, or when the harness was interrupted, and it ends the worker without asking the task.
    """
    key, done = thread_state.key, threading.Event()

    def watch() -> None:
        while not done.wait(POLL_S):
            task = worker.state.tasks.get(key)
            if worker.status not in _ALIVE or task is None or task.state not in _WANTED:
                runner.stop()
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()

"""Run one command within bounds that hold for everything that it starts.

On Linux this process becomes a *subreaper*: a descendant whose parent ends, even one that
called setsid or forked twice, becomes our child instead of init's. So as long as we have no
child, no descendant is alive, and as long as one is, we find it below us. Elsewhere
only the command's own process group can be ended. Where control groups work, the
command has one of its own beside.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import select
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from harness import landlock, processes, scratch
from harness.bounds import (
    AFFINITY,
    CGROUP,
    CPU,
    CPUSET,
    GROUP,
    LANDLOCK,
    NOTHING,
    SAMPLES,
    SUBREAPER,
    WALL,
    Bounds,
    Means,
    Outcome,
)
from harness.cgroups import Cell, Cells
from harness.watch import Watch

#: A command is told to end (SIGTERM) this long, in seconds, after its limit of wall time, ...
GRACE_S = 0.1
#: ... and whatever is then still alive is killed (SIGKILL) this much later, ...
POLITE_S = 0.15
#: ... again and again until nothing is left, for at most this long.
GIVE_UP_S = 20.0
#: Its control group is frozen and killed where killing has taken this long.
_FREEZE_AFTER_S = 0.1

_PR_SET_CHILD_SUBREAPER = 36
#: The kernel, out of memory, kills processes with this score first.
_FIRST_TO_GO = b"1000"


def become_subreaper() -> bool:
    """Make orphaned descendants our children; False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        library = ctypes.CDLL(None, use_errno=True)
        return library.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) == 0
    except (OSError, AttributeError):
        return False


class Bell:
    """Wakes a wait when a child ends, when told to stop, or after a time.

    stop: a file descriptor that becomes readable, or ends, when all work is to stop.
    """

    def __init__(self, stop: int) -> None:
        self.stopped = False
        self._stop = stop
        self._read, self._write = os.pipe()
        os.set_blocking(self._read, False)
        os.set_blocking(self._write, False)
        signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        # Only the end of ``stop`` stops us. A handler, unlike SIG_IGN, is not inherited.
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda *_: None)

    def wait(self, seconds: float) -> None:
        """Return after ``seconds``, or earlier when something happened."""
        poll = select.poll()
        poll.register(self._read, select.POLLIN)
        if not self.stopped:
            poll.register(self._stop, select.POLLIN)
        for fd, _ in poll.poll(max(0.0, seconds) * 1000):
            if fd == self._stop:
                self.stopped = True
        with contextlib.suppress(BlockingIOError):
            while os.read(self._read, 4096):
                pass


class Tree:
    """One command and all of its descendants.

    setup: called in the new process before it becomes the command. OSError if it can't start.
    """

    def __init__(
        self,
        command: list[str],
        cwd: str,
        env: dict[str, str],
        log: int,
        setup: Callable[[], None] | None,
    ) -> None:
        self.exit_code: int | None = None
        self.cpu_s, self.max_rss = 0.0, 0
        # Output goes to a file: nobody waits for a pipe that a grandchild keeps open.
        self._main = subprocess.Popen(
            command,
            cwd=cwd,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
            preexec_fn=setup,  # noqa: PLW1509 (this process has one thread)
        )

    def prepare(self, bounds: Bounds) -> None:
        """Set what a process that has just been started hands on to its children."""
        pid = self._main.pid
        with contextlib.suppress(OSError):
            Path(f"/proc/{pid}/oom_score_adj").write_bytes(_FIRST_TO_GO)
        if bounds.cpu_s is not None and hasattr(resource, "prlimit"):
            most = int(bounds.cpu_s) + 2
            with contextlib.suppress(OSError, ValueError):
                resource.prlimit(pid, resource.RLIMIT_CPU, (most, most))

    def reap(self) -> bool:
        """Collect every ended child; return whether a child is left."""
        while True:
            try:
                pid, status, usage = os.wait4(-1, os.WNOHANG)
            except ChildProcessError:
                return False
            if pid == 0:
                return True
            self.cpu_s += usage.ru_utime + usage.ru_stime
            unit = 1 if sys.platform == "darwin" else 1024
            self.max_rss = max(self.max_rss, usage.ru_maxrss * unit)
            if pid == self._main.pid:
                code = os.waitstatus_to_exitcode(status)
                self.exit_code = self._main.returncode = code if code >= 0 else 128 - code

    def end(self, bell: Bell, polite_s: float, cell: Cell | None) -> int:
        """End whatever is left of the tree; return how many processes could not be killed.

        polite_s: time between being told to end and being killed; 0: killed at once.
        """
        if not self.reap():
            return 0
        now = time.monotonic()
        polite, give_up = now + polite_s, now + GIVE_UP_S
        freeze = polite + _FREEZE_AFTER_S
        if polite_s:
            self._signal(signal.SIGTERM)
        while self.reap() and (now := time.monotonic()) < give_up:
            if now < polite:
                bell.wait(polite - now)
                continue
            self._signal(signal.SIGKILL)
            if cell is not None and now > freeze:
                cell.kill()
                freeze = time.monotonic() + 1.0
            bell.wait(0.005)
        return len([p for p in processes.descendants() if not p.zombie]) if self.reap() else 0

    def _signal(self, number: int) -> None:
        """Send a signal to every descendant, whole process groups at once.

        The kernel delivers to a group and forks under one lock, so that a process that
        forks in a loop cannot slip out of a group that is being killed.
        """
        below = processes.descendants()
        groups = {self._main.pid, *(process.group for process in below)}
        for group in groups - {os.getpgrp()}:
            with contextlib.suppress(OSError):
                os.killpg(group, number)
        for process in below:
            with contextlib.suppress(OSError):
                os.kill(process.pid, number)


def run_limited(
    command: list[str],
    cwd: str,
    env: dict[str, str],
    log: str,
    bounds: Bounds,
    bell: Bell,
    cells: Cells | None,
    signals: str = NOTHING,
) -> Outcome:
    """Run a command; return when it and everything that it started has ended.

    log: the file that its output is appended to; cells: where control groups are to be made;
    signals: what already keeps it from signalling others. Raises OSError if it cannot be started.
    """
    cell = None
    if cells is not None:
        with contextlib.suppress(OSError):
            cell = cells.cell(bounds.memory, bounds.cores)
    rules = _rules(bounds)
    output = _open_log(log)
    try:
        start = time.monotonic()
        pinned = cell is not None and cells is not None and cells.can_pin
        watch = Watch(bounds, output, cell)
        with _pinned(None if pinned else bounds.cores):
            tree = Tree(command, cwd, env, output, _setup(cell, rules))
        tree.prepare(bounds)
        means = _means(bounds, cell, pinned, rules, signals)
        return _wait(tree, start, bounds, bell, cell, watch, means)
    finally:
        os.close(output)
        if rules is not None:
            rules.close()
        if cell is not None:
            cell.remove()


def _open_log(path: str) -> int:
    """Open a log to append to; the command before may have put anything in its place."""
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    with contextlib.suppress(OSError):
        fd = os.open(path, flags, 0o600)
        if stat.S_ISREG(os.fstat(fd).st_mode):
            return fd
        os.close(fd)
    scratch.remove(path)
    return os.open(path, flags | os.O_EXCL, 0o600)


def _wait(
    tree: Tree,
    start: float,
    bounds: Bounds,
    bell: Bell,
    cell: Cell | None,
    watch: Watch,
    means: Means,
) -> Outcome:
    exceeded = None
    deadline = start + bounds.wall_s + GRACE_S
    while tree.exit_code is None and exceeded is None and not bell.stopped:
        now = time.monotonic()
        if now >= deadline:
            exceeded = WALL
        elif now >= watch.next:
            exceeded = watch.look(tree.cpu_s, deadline)
        else:
            bell.wait(min(deadline, watch.next) - now)
        tree.reap()
    wall = time.monotonic() - start
    ended = tree.exit_code is None
    in_time = exceeded in (None, WALL, CPU)
    survivors = tree.end(bell, POLITE_S if in_time else 0.0, cell)
    if ended:
        wall = time.monotonic() - start
    last = watch.last_look(tree.cpu_s, tree.max_rss)
    return Outcome(
        exit_code=128 + signal.SIGKILL if tree.exit_code is None else tree.exit_code,
        exceeded=exceeded or last,
        wall_s=wall,
        cpu_s=watch.cpu_s,
        max_memory=watch.memory,
        survivors=survivors,
        means=means,
    )


def _rules(bounds: Bounds) -> landlock.Rules | None:
    """Return what keeps the command in its scratch folder, where that is asked for and can be."""
    if not bounds.contain or bounds.folder is None or not landlock.can_forbid_writes():
        return None
    try:
        return landlock.Rules(bounds.folder, landlock.can_forbid_signals(no_new_privileges=True))
    except OSError:
        return None


def _setup(cell: Cell | None, rules: landlock.Rules | None) -> Callable[[], None] | None:
    """Return what a new process must do itself before it becomes the command.

    None, where there is nothing: then the process is made without copying this one.
    """
    if cell is None and rules is None:
        return None

    def setup() -> None:
        if cell is not None:
            cell.enter()
        if rules is not None:
            rules.enforce()

    return setup


@contextlib.contextmanager
def _pinned(cores: tuple[int, ...] | None) -> Iterator[None]:
    """Run on these cores meanwhile; what is started then stays there."""
    if not cores or not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _means(
    bounds: Bounds, cell: Cell | None, pinned: bool, rules: landlock.Rules | None, signals: str
) -> Means:
    cores = NOTHING
    if bounds.cores:
        can = hasattr(os, "sched_setaffinity")
        cores = CPUSET if pinned else AFFINITY if can else NOTHING
    found = SUBREAPER if sys.platform.startswith("linux") else GROUP
    return Means(
        processes=found if cell is None else f"{CGROUP}, {found}",
        cpu=SAMPLES if cell is None else CGROUP,
        memory=SAMPLES if cell is None else CGROUP,
        cores=cores,
        writes=NOTHING if rules is None else LANDLOCK,
        signals=LANDLOCK if rules is not None and rules.signals else signals,
    )

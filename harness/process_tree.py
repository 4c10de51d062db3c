"""Run one command with a wall-time limit on everything that it starts.

On Linux this process becomes a *subreaper*: a descendant whose parent ends, even one that
called setsid or forked twice, becomes our child instead of init's. So as long as we have no
child, no descendant is alive, and as long as one is, we find it below us. Elsewhere
only the command's own process group can be ended.

The module runs as a small process of its own (``python process_tree.py SCRATCH``), one
request a line on standard input, one answer a line on standard output. It needs the standard
library and psutil only: it is forked for every command, and its size is the floor of
the memory that is measured. When its standard input ends, because the harness closed
it or was killed, it ends the command's whole tree, removes SCRATCH and ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

#: A command is told to end (SIGTERM) this long, in seconds, after its limit, ...
GRACE_S = 0.1
#: ... and whatever is then still alive is killed (SIGKILL) this much later, ...
POLITE_S = 0.15
#: ... again and again until nothing is left, for at most this long.
GIVE_UP_S = 20.0

_PR_SET_CHILD_SUBREAPER = 36


@dataclass(frozen=True)
class Outcome:
    """How a command ended.

    exit_code: 128 + the signal's number if a signal ended it; timed_out: whether it was ended
    at its limit; wall_s: from before its start to its end; cpu_s: user and system time of it
    and of all descendants that were waited for; max_rss_kib: memory of the largest
    single process among them; survivors: processes that could not be killed.
    """

    exit_code: int
    timed_out: bool
    wall_s: float
    cpu_s: float
    max_rss_kib: int
    survivors: int


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


class _Tree:
    """One command and all of its descendants."""

    def __init__(self, command: list[str], cwd: str, env: dict[str, str], log: str) -> None:
        self.exit_code: int | None = None
        self.cpu_s, self.max_rss_kib = 0.0, 0
        # Output goes to a file: nobody waits for a pipe that a grandchild keeps open.
        with Path(log).open("ab") as output:
            self._main = subprocess.Popen(
                command,
                cwd=cwd,
                env=env,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )

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
            unit = 1024 if sys.platform == "darwin" else 1
            self.max_rss_kib = max(self.max_rss_kib, usage.ru_maxrss // unit)
            if pid == self._main.pid:
                code = os.waitstatus_to_exitcode(status)
                self.exit_code = self._main.returncode = code if code >= 0 else 128 - code

    def end(self, bell: Bell) -> int:
        """End whatever is left of the tree; return how many processes could not be killed."""
        if self._gone():
            return 0
        self._signal(signal.SIGTERM)
        now = time.monotonic()
        polite, give_up = now + POLITE_S, now + GIVE_UP_S
        while not self._gone() and (now := time.monotonic()) < give_up:
            if now < polite:
                bell.wait(polite - now)
            else:
                self._signal(signal.SIGKILL)
                bell.wait(0.005)
        return 0 if self._gone() else len(list(_descendants()))

    def _gone(self) -> bool:
        return not self.reap()

    def _signal(self, number: int) -> None:
        """Send a signal to every descendant, whole process groups at once.

        The kernel delivers to a group and forks under one lock, so that a process that
        forks in a loop cannot slip out of a group that is being killed.
        """
        import psutil  # noqa: PLC0415 (most trees leave nothing behind)

        own = os.getpgrp()
        groups = {self._main.pid}
        processes = list(_descendants())
        for process in processes:
            with contextlib.suppress(OSError):
                groups.add(os.getpgid(process.pid))
        for group in groups - {own}:
            with contextlib.suppress(OSError):
                os.killpg(group, number)
        for process in processes:
            with contextlib.suppress(psutil.Error, OSError):
                process.send_signal(number)


def _descendants() -> Iterator[Any]:
    import psutil  # noqa: PLC0415

    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if process.status() != psutil.STATUS_ZOMBIE:
                yield process


def run_limited(
    command: list[str], cwd: str, env: dict[str, str], log: str, limit_s: float, bell: Bell
) -> Outcome:
    """Run a command; return when it and everything that it started has ended.

    log: the file that its output is appended to. Raises OSError if it cannot be started.
    """
    start = time.monotonic()
    tree = _Tree(command, cwd, env, log)
    deadline = start + limit_s + GRACE_S
    while tree.exit_code is None and not bell.stopped and time.monotonic() < deadline:
        bell.wait(deadline - time.monotonic())
        tree.reap()
    wall = time.monotonic() - start
    timed_out = tree.exit_code is None
    survivors = tree.end(bell)
    if timed_out:
        wall = time.monotonic() - start
    code = 128 + signal.SIGKILL if tree.exit_code is None else tree.exit_code
    return Outcome(code, timed_out, wall, tree.cpu_s, tree.max_rss_kib, survivors)


def _read_line() -> bytes | None:
    """Read a request; None when there are no more."""
    line = b""
    while not line.endswith(b"\n"):
        part = os.read(0, 1 << 16)
        if not part:
            return None
        line += part
    return line


def _answer(data: dict[str, Any]) -> None:
    os.write(1, json.dumps(data).encode() + b"\n")


def serve(scratch: str) -> None:
    """Answer requests until standard input ends."""
    kept_by = "subreaper" if become_subreaper() else "process group"
    bell = Bell(stop=0)
    try:
        _answer({"kept_by": kept_by})
        while (line := _read_line()) is not None:
            try:
                _answer(asdict(run_limited(**json.loads(line), bell=bell)))
            except OSError as error:
                _answer({"error": f"{error.filename or 'the command'}: {error.strerror}"})
            if bell.stopped:
                break
    except BrokenPipeError:
        pass
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


if __name__ == "__main__":
    serve(sys.argv[1])

"""The harness's side of process_tree: a process that runs commands and outlives nobody.

If the harness is killed, at any instant and by any signal, the supervisor sees its standard
input end, ends the running tool's whole tree and removes the scratch folder.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import psutil

from harness import process_tree
from harness.process_tree import Outcome

#: The supervisor may take this long (seconds) to end a tree and itself.
_CLOSE_S = process_tree.GIVE_UP_S + 5

#: This variable in the environment marks all processes of a tool, in case of need.
_MARK = "HARNESS_SCRATCH"


class SupervisorLost(Exception):
    """The process that keeps the limits is gone: something killed it."""


class CannotStart(Exception):
    """A command could not be started; the message says why."""


class Supervisor:
    """Runs one command at a time under a limit, each below a scratch folder of its own.

    keep: file descriptors that stay open as long as the supervisor lives (a lock, so that
    nobody else starts while it is still ending processes); cores: those that it and all it
    starts are pinned to. ``kept_by`` says by what means limits are kept: "subreaper" or
    "process group".
    """

    def __init__(self, keep: Sequence[int] = (), cores: Sequence[int] | None = None) -> None:
        self.scratch = Path(tempfile.mkdtemp(prefix="harness-"))
        self._process = subprocess.Popen(
            [sys.executable, "-P", process_tree.__file__, str(self.scratch)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=tuple(keep),
            start_new_session=True,  # so that Ctrl-C reaches the harness alone
        )
        if cores is not None and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(self._process.pid, cores)
        self.kept_by: str = self._receive()["kept_by"]

    def run(
        self, command: Sequence[str], cwd: Path, env: Mapping[str, str], log: Path, limit_s: float
    ) -> Outcome:
        """Run a command and return how it ended, after all that it started has ended.

        Raises CannotStart, or SupervisorLost.
        """
        request = {
            "command": list(command),
            "cwd": str(cwd),
            "env": {**env, _MARK: str(self.scratch)},
            "log": str(log),
            "limit_s": limit_s,
        }
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except (BrokenPipeError, ValueError):  # ValueError: stop() closed it
            raise SupervisorLost from None
        answer = self._receive()
        if "error" in answer:
            raise CannotStart(answer["error"])
        return Outcome(**answer)

    def _receive(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line.endswith(b"\n"):
            raise SupervisorLost
        answer: dict[str, Any] = json.loads(line)
        return answer

    def stop(self) -> None:
        """End what runs, from another thread; then only close() may be called."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()

    def close(self) -> None:
        """End what runs, remove the scratch folder, end the supervisor."""
        assert self._process.stdout is not None
        self.stop()
        try:
            self._process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        if self._process.returncode != 0:
            _end_marked(str(self.scratch))
        # Again: after stop() something may have been put there.
        shutil.rmtree(self.scratch, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _end_marked(mark: str) -> None:
    """Kill what a lost supervisor left behind: all processes that carry its mark."""
    give_up = time.monotonic() + process_tree.GIVE_UP_S
    while time.monotonic() < give_up:
        marked = [process for process in psutil.process_iter() if _has_mark(process, mark)]
        if not marked:
            return
        for process in marked:
            with contextlib.suppress(psutil.Error):
                process.kill()
        time.sleep(0.01)


def _has_mark(process: psutil.Process, mark: str) -> bool:
    try:
        return process.environ().get(_MARK) == mark
    except (psutil.Error, OSError):
        return False

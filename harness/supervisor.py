"""The harness's side of the keeper: a process that runs commands and outlives nobody.

If the harness is killed, at any instant and by any signal, the keeper sees its standard
input end, ends the running tool's whole tree and removes the scratch folder.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import psutil

from harness import process_tree, scratch
from harness.bounds import Bounds, Means, Outcome
from harness.closing import Closing

#: The keeper may take this long (seconds) to end a tree and itself.
_CLOSE_S = process_tree.GIVE_UP_S + 5

#: This variable in the environment marks all processes of a tool, in case of need.
_MARK = "HARNESS_SCRATCH"


class SupervisorLost(Exception):
    """The process that keeps the limits is gone: something killed it."""


class CannotStart(Exception):
    """A command could not be started; the message says why."""


class Supervisor(Closing):
    """Runs one command at a time within bounds, each below a scratch folder of its own.

    keep: file descriptors that stay open as long as the keeper lives (a lock, so that
    nobody else starts while it is still ending processes). cgroups: whether to use control
    groups where they work.
    """

    def __init__(self, keep: Sequence[int] = (), cgroups: bool = True) -> None:
        self.scratch = Path(tempfile.mkdtemp(prefix="harness-"))
        program = [sys.executable, "-P", str(Path(__file__).with_name("keeper.py"))]
        self._process = subprocess.Popen(
            [*program, str(self.scratch), *([] if cgroups else ["--no-cgroups"])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=tuple(keep),
            start_new_session=True,  # so that Ctrl-C reaches the harness alone
        )
        try:
            self._receive()
        except SupervisorLost:
            self.close()
            raise

    def run(
        self, command: Sequence[str], cwd: Path, env: Mapping[str, str], log: Path, bounds: Bounds
    ) -> Outcome:
        """Run a command and return how it ended, after all that it started has ended.

        log: the file that its output is appended to. Raises CannotStart, or SupervisorLost.
        """
        request = {
            "command": list(command),
            "cwd": str(cwd),
            "env": {**env, _MARK: str(self.scratch)},
            "log": str(log),
            "bounds": asdict(bounds),
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
        return Outcome(**{**answer, "means": Means(**answer["means"])})

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
        if self._process.stdout.closed:
            return
        self.stop()
        try:
            self._process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._wait_for_keeper()
        self._process.stdout.close()
        if self._process.returncode != 0:
            _end_marked(str(self.scratch))
        # Always: after stop() something may have been put there again.
        scratch.remove(str(self.scratch))

    def _wait_for_keeper(self) -> None:
        """Wait until no keeper can answer any more: it outlives its guard where that was killed."""
        assert self._process.stdout is not None
        answers = self._process.stdout.fileno()
        give_up = time.monotonic() + _CLOSE_S
        while select.select([answers], [], [], max(0.0, give_up - time.monotonic()))[0]:
            if not os.read(answers, 1 << 16):
                return


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

"""The program that keeps the limits of tools: ``python keeper.py SCRATCH [--no-cgroups]``.

A small process of its own, one request a line on standard input, one answer a line on standard
output. It is forked for every command, so that its size is the floor of the memory that is
measured without control groups: it imports little. When its standard input ends, because the
harness closed it or was killed, it ends the command's whole tree, removes SCRATCH and ends.

It has a guard, its parent, which does nothing but wait. If a tool kills the keeper, the guard
gets all that the tool started, ends it and removes SCRATCH.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from subprocess import SubprocessError
from typing import Any

if __name__ == "__main__":
    # It is started without the folder of this file, or the current one, among Python's paths.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from harness import landlock, processes, scratch
from harness.bounds import LANDLOCK, NOTHING, Bounds, Outcome
from harness.cgroups import Cells, remove_all
from harness.process_tree import GIVE_UP_S, Bell, become_subreaper, run_limited

NO_CGROUPS = "--no-cgroups"


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


def _run(request: dict[str, Any], bell: Bell, cells: Cells | None, signals: str) -> Outcome:
    request["bounds"] = Bounds(**request["bounds"])
    if cells is not None:
        # Where a group cannot be entered, or there can be none any more, there are other means.
        with suppress(SubprocessError):
            return run_limited(**request, bell=bell, cells=cells, signals=signals)
    return run_limited(**request, bell=bell, cells=None, signals=signals)


def _stay_apart() -> str:
    """Forbid this process, and all that it will start, to signal others; return by what means.

    A tool can then kill its keeper, but neither guard nor harness nor anything else.
    """
    if not landlock.can_forbid_signals(no_new_privileges=False):
        return NOTHING
    try:
        rules = landlock.Rules(None, signals=True)
        rules.enforce()
        rules.close()
    except OSError:
        return NOTHING
    return LANDLOCK


def serve(folder: str, cgroups: bool) -> None:
    """Answer requests until standard input ends."""
    become_subreaper()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # of all commands
    signals = _stay_apart()
    bell = Bell(stop=0)
    cells = Cells.open() if cgroups else None
    try:
        _answer({"ready": True})
        while (line := _read_line()) is not None:
            try:
                _answer(asdict(_run(json.loads(line), bell, cells, signals)))
            except OSError as error:
                _answer({"error": f"{error.filename or 'the command'}: {error.strerror}"})
            except SubprocessError as error:
                _answer({"error": f"the command: {error}"})
            if bell.stopped:
                break
    except BrokenPipeError:
        pass
    finally:
        scratch.remove(folder)
        if cells is not None:
            cells.close()


def _guard(keeper: int, folder: str) -> int:
    """Wait for the keeper; return its exit status, after cleaning up where it did not."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: None)
    while True:
        pid, status = os.wait()
        if pid == keeper:
            break
    if status == 0:
        return 0
    give_up = time.monotonic() + GIVE_UP_S
    while _has_children() and time.monotonic() < give_up:
        for process in processes.descendants():
            with suppress(OSError):
                os.kill(process.pid, signal.SIGKILL)
        time.sleep(0.002)
    remove_all(keeper)
    scratch.remove(folder)
    return 1


def _has_children() -> bool:
    """Collect all children that ended; return whether one is left."""
    while True:
        try:
            pid, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return False
        if pid == 0:
            return True


def main(folder: str, cgroups: bool) -> None:
    """Start the keeper, and be its guard."""
    become_subreaper()
    # Scripts of VNN-COMP's tools say ``killall python``, and don't mean us.
    with suppress(OSError):
        Path("/proc/self/comm").write_text("closedlap-keep")
    keeper = os.fork()
    if keeper:
        os._exit(_guard(keeper, folder))
    try:
        serve(folder, cgroups)
    except BaseException:
        os._exit(1)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1], NO_CGROUPS not in sys.argv[2:])

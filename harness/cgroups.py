"""Control groups, where they work: the kernel measures, bounds and freezes a whole tree.

BenchExec (package ``benchexec``) finds out where groups can be made, for both versions of the
kernel's interface, and makes, reads, empties and removes them. Its RunExecutor is not used:
it keeps a wall limit about a second late, tells nobody to end before it kills, and takes
0.1 s more for each command than it runs (bench/overhead.py measures it).
"""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

#: All that a group's files may raise when the tool, being root, has tampered with them.
#: BenchExec ends the program where it cannot go on.
_FAILURES = (OSError, ValueError, AssertionError, SystemExit)
#: Names of groups begin with this and the maker's process ID.
_PREFIX = "closedlap_"
#: A probe burns this much CPU time (s), ...
_PROBE_CPU_S = 0.002
#: ... and takes twice this much memory (bytes).
_PROBE_MEMORY = 8 << 20


class Cell:
    """The group of one command."""

    def __init__(self, group: Any) -> None:
        self._group = group

    def enter(self) -> None:
        """Move this process into the group."""
        self._group.add_task(os.getpid())

    def cpu_s(self) -> float | None:
        """Return the CPU time of all that ever ran here, s."""
        with suppress(*_FAILURES):
            return float(self._group.read_cputime())
        return None

    def peak(self) -> int | None:
        """Return the most memory that was in use at once, bytes, cached files included."""
        with suppress(*_FAILURES):
            value = self._group.read_max_mem_usage()
            return None if value is None else int(value)
        return None

    def was_full(self) -> bool:
        """Whether the kernel has killed a process here since it needed more than the bound."""
        with suppress(*_FAILURES):
            if self._group.version == 1:
                pairs = dict(self._group.get_key_value_pairs(self._group.MEMORY, "oom_control"))
                return int(pairs.get("oom_kill", 0)) > 0
            return bool(self._group.read_oom_kill_count())
        return False

    def kill(self) -> None:
        """Freeze all that is here and kill it: what forks cannot get away.

        BenchExec's own way waits half a second where it finds something, and this must not.
        """
        group = Path(self._group[self._group.FREEZE])
        if self._group.version == 1:
            state, freeze, thaw = "freezer.state", "FROZEN", "THAWED"
        else:
            state, freeze, thaw = "cgroup.freeze", "1", "0"
        with suppress(*_FAILURES):
            (group / state).write_text(freeze)
        # The tool may have made groups of its own in this one.
        folders = [Path(folder) for folder, _, _ in os.walk(group)]
        for folder in folders:
            with suppress(*_FAILURES):
                for pid in (folder / "cgroup.procs").read_text().split():
                    with suppress(ProcessLookupError):
                        os.kill(int(pid), signal.SIGKILL)
        for folder in folders:
            with suppress(*_FAILURES):
                (folder / state).write_text(thaw)

    def remove(self) -> None:
        """Kill what is left, and remove the group."""
        with suppress(*_FAILURES):
            self._group.kill_all_tasks()
        with suppress(*_FAILURES, AttributeError):
            self._group.remove()


class Cells:
    """Makes cells; ``open`` returns None where that does not work.

    can_pin: whether a cell can be bound to cores.
    """

    def __init__(self, parent: Any, before: str) -> None:
        self._parent, self._before = parent, before
        self._needed = [parent.CPU, parent.MEMORY, parent.FREEZE]
        self.can_pin = parent.CPUSET in parent

    @classmethod
    def open(cls) -> Cells | None:
        """Find groups that can be used, and try them: measure, bound memory, kill.

        This process may be moved to another group.
        """
        # BenchExec explains at length what is missing; we say it in every record.
        logging.disable(logging.CRITICAL)
        try:
            from benchexec.cgroups import Cgroups  # noqa: PLC0415 (slow, and Linux only)

            before = _own_group()
            parent = Cgroups.initialize()
            for name in ("CPU", "MEMORY", "FREEZE", "CPUSET"):
                parent.require_subsystem(getattr(parent, name))
            if not all(getattr(parent, name) in parent for name in ("CPU", "MEMORY", "FREEZE")):
                return None
            cells = cls(parent, before)
            return cells if cells._work() else None
        except (Exception, SystemExit):  # whatever is wrong with them, there are other means
            return None

    def cell(self, memory: int | None = None, cores: tuple[int, ...] | None = None) -> Cell:
        """Make a group. OSError if it can't be made.

        memory: what all processes in it may use at once, bytes; cores: those to run on.
        """
        names = [*self._needed, *([self._parent.CPUSET] if cores and self.can_pin else [])]
        try:
            prefix = f"{_PREFIX}{os.getpid()}_"
            group = self._parent.create_fresh_child_cgroup(names, prefix=prefix)
        except (ValueError, AssertionError, SystemExit) as error:
            raise OSError(0, f"no cgroup ({error})") from None
        cell = Cell(group)
        try:
            if cores and self.can_pin:
                group.set_value(group.CPUSET, "cpus", ",".join(map(str, cores)))
            if memory is not None:
                group.write_memory_limit(memory)
                with suppress(*_FAILURES):  # where nothing is swapped there may be no such file
                    group.disable_swap()
        except _FAILURES as error:
            cell.remove()
            raise OSError(0, f"no cgroup ({error})") from None
        return cell

    def close(self) -> None:
        """Leave the group that this process was moved to, and remove it where that can be."""
        own = PurePosixPath(_own_group())
        if self._parent.version == 1 or str(own) == self._before:
            return
        with suppress(*_FAILURES):
            parent = Path(self._parent.path)
            mount = str(parent).removesuffix(str(own.parent))
            Path(f"{mount}{self._before}/cgroup.procs").write_text(str(os.getpid()))
            (parent / own.name).rmdir()
            parent.rmdir()

    def _work(self) -> bool:
        """Try a group on a process of our own: files that are there may yet do nothing."""
        with _removed(self.cell(_PROBE_MEMORY)) as cell:
            pid = os.fork()
            if pid == 0:
                _misbehave(cell)
            _, status = os.waitpid(pid, 0)
            killed = os.waitstatus_to_exitcode(status) == -signal.SIGKILL
            return killed and cell.was_full() and (cell.cpu_s() or 0) >= _PROBE_CPU_S


def _own_group() -> str:
    """Return the name of this process's group, in version 2 of the interface; empty without."""
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            if line.startswith("0::"):
                return line.removeprefix("0::")
    return ""


def remove_all(pid: int) -> None:
    """Remove the empty groups that a process which is gone made beside our own."""
    with suppress(ImportError, AttributeError, *_FAILURES):
        from benchexec.cgroups import Cgroups  # noqa: PLC0415

        for path in Cgroups.from_system().paths:
            for group in Path(path).glob(f"{_PREFIX}{pid}_*"):
                with suppress(OSError):
                    group.rmdir()


@contextmanager
def _removed(cell: Cell) -> Iterator[Cell]:
    try:
        yield cell
    finally:
        cell.remove()


def _misbehave(cell: Cell) -> None:
    """Burn CPU time and take more memory than allowed; never returns."""
    with suppress(BaseException):
        cell.enter()
        while time.process_time() < 2 * _PROBE_CPU_S:
            pass
        bytearray(b"x") * (2 * _PROBE_MEMORY)
    os._exit(0)

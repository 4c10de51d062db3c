"""Looks now and then at what a command uses, and says when it is too much."""

from __future__ import annotations

import os
import time
from contextlib import suppress

from harness import processes, scratch
from harness.bounds import CPU, MEMORY, OUTPUT, SCRATCH, Bounds
from harness.cgroups import Cell
from harness.processes import Process

#: Time between two looks (s), ...
INTERVAL_S = 0.05
#: ... or this many times what a look takes, so that looking costs a core a twentieth; ...
_THRIFT = 20
#: ... this many times where it decides whether the bound of memory is passed.
_THRIFT_AT_BOUND = 3


class Watch:
    """What one command has used so far.

    log: file descriptor of its printed output; cell: its control group, if it has one. What the
    cell doesn't measure is summed over the processes that are there.

    cpu_s: s; memory: the most at once, bytes.
    """

    def __init__(self, bounds: Bounds, log: int, cell: Cell | None) -> None:
        self.cpu_s, self.memory = 0.0, 0
        self._bounds, self._log, self._cell = bounds, log, cell
        self._lost_cpu_s = self._seen_cpu_s = 0.0
        self._asked = self._asking_took = 0.0
        self.next = time.monotonic() + INTERVAL_S

    def look(self, reaped_cpu_s: float, deadline: float) -> str | None:
        """Return what has become too much, if anything.

        reaped_cpu_s: of those that ended; deadline: (time.monotonic) when to have looked.
        """
        start, asked = time.monotonic(), self._asked
        peak = None
        if self._cell is not None:
            peak = self._cell.peak()
            self.cpu_s = max(self.cpu_s, self._cell.cpu_s() or 0.0)
        if self._cell is None or peak is None:
            self._sample(reaped_cpu_s)
        else:
            self.memory = max(self.memory, peak)
        exceeded = self._exceeded(deadline)
        end = time.monotonic()
        took = end - start - (self._asking_took if self._asked != asked else 0.0)
        self.next = end + max(INTERVAL_S, _THRIFT * took)
        return exceeded

    def last_look(self, reaped_cpu_s: float, max_rss: int) -> str | None:
        """The same after the end; max_rss: bytes, of the largest single process."""
        if self._cell is not None:
            self.cpu_s = max(self.cpu_s, self._cell.cpu_s() or 0.0)
        self.cpu_s = max(self.cpu_s, reaped_cpu_s + self._lost_cpu_s)
        peak = None if self._cell is None else self._cell.peak()
        self.memory = max(self.memory, max_rss if peak is None else peak)
        return self._exceeded(float("inf"))

    def _sample(self, reaped_cpu_s: float) -> None:
        below = processes.descendants()
        used = reaped_cpu_s + sum(process.cpu_s for process in below)
        # Time of a child is lost when its parent does not care (SIGCHLD ignored): the sum falls.
        self._lost_cpu_s += max(0.0, self._seen_cpu_s - used)
        self._seen_cpu_s = used
        self.cpu_s = max(self.cpu_s, used + self._lost_cpu_s)
        memory = sum(process.rss for process in below)
        if memory > self.memory:
            self.memory = max(self.memory, self._shared_out(below, memory))

    def _shared_out(self, below: list[Process], memory: int) -> int:
        """Return the memory in use where shared pages count once; 0 where it's too early to ask.

        memory: the sum in which they count for every process.
        """
        if not below[1:]:
            return memory
        bound = self._bounds.memory
        thrift = _THRIFT if bound is None or memory <= bound else _THRIFT_AT_BOUND
        start = time.monotonic()
        if start < self._asked + thrift * self._asking_took:
            return 0
        shared_out = processes.shared_out(below)
        self._asked = time.monotonic()
        self._asking_took = self._asked - start
        return shared_out

    def _exceeded(self, deadline: float) -> str | None:
        bounds = self._bounds
        if bounds.memory is not None and self._is_full(bounds.memory):
            return MEMORY
        if bounds.cpu_s is not None and self.cpu_s > bounds.cpu_s:
            return CPU
        if bounds.output is not None and self._output() > bounds.output:
            return OUTPUT
        if bounds.scratch is not None and self._scratch(deadline) > bounds.scratch:
            return SCRATCH
        return None

    def _is_full(self, bound: int) -> bool:
        if self._cell is None:
            return self.memory > bound
        # The peak counts cached files too, which the kernel gives up before it refuses memory.
        return self._cell.was_full()

    def _scratch(self, deadline: float) -> float:
        folder = self._bounds.folder
        if folder is None:
            return 0.0
        # The log is a file beside the folder: some file systems give folders another number.
        device = os.fstat(self._log).st_dev
        return scratch.disk_usage(folder, deadline) + processes.unlinked_files(device)

    def _output(self) -> int:
        """Return the size of the larger of the printed output and the result file, bytes."""
        sizes = [os.fstat(self._log).st_size]
        if self._bounds.result is not None:
            with suppress(OSError):
                sizes.append(os.lstat(self._bounds.result).st_size)
        return max(sizes)

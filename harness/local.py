"""Run instances on this machine, several at a time, each job on cores of its own."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from queue import Empty, Queue

from harness.catalogue import Entry
from harness.closing import Closing
from harness.job import Result, Setting, run_job
from harness.runner import Runner, Stopped


class LocalJobs(Closing):
    """Threads that run instances; a context manager that ends whatever runs.

    places: for each job the cores that it is pinned to, None for all; keep: file descriptors
    that stay open until no process of a tool is left.
    """

    def __init__(
        self, setting: Setting, places: Sequence[Sequence[int] | None], keep: Sequence[int]
    ) -> None:
        self._setting, self._places, self._keep = setting, places, keep
        self._stopping = False
        self._lock = threading.Lock()
        self._runners: list[Runner] = []
        self._threads: list[threading.Thread] = []
        # A job may be one result ahead of what is stored: storing takes as long as the disk does.
        self._done: Queue[Result | BaseException] = Queue(len(places))

    def install(self) -> tuple[str | None, bytes]:
        """Run install_tool.sh, on all cores; return what is wrong, if anything, and its log."""
        with self._setting.runner(self._keep) as runner:
            return runner.install()

    def results(
        self, entries: Sequence[Entry], on_start: Callable[[Entry], None]
    ) -> Iterator[Result]:
        """Run instances; yield results as they come. ``on_start`` is called from other threads."""
        waiting = deque(entries)
        self._threads = [
            threading.Thread(target=self._work, args=(place, waiting, on_start), daemon=True)
            for place in self._places[: len(entries)]
        ]
        for thread in self._threads:
            thread.start()
        for _ in entries:
            result = self._done.get()
            if isinstance(result, BaseException):
                raise result
            yield result

    def _work(
        self,
        place: Sequence[int] | None,
        waiting: deque[Entry],
        on_start: Callable[[Entry], None],
    ) -> None:
        try:
            if place is not None and hasattr(os, "sched_setaffinity"):
                os.sched_setaffinity(0, place)  # of this thread alone, which also checks witnesses
            with self._setting.runner(self._keep, place) as runner:
                with self._lock:
                    self._runners.append(runner)
                while waiting and not self._stopping:
                    try:
                        entry = waiting.popleft()
                    except IndexError:
                        return
                    on_start(entry)
                    self._done.put(run_job(runner, entry))
        except Stopped:
            pass
        except BaseException as error:  # whatever it is, it is raised where results are read
            self._done.put(error)

    def stop(self) -> list[Result]:
        """End all tools; return results that had come in and were not read."""
        with self._lock:
            self._stopping = True
            for runner in self._runners:
                runner.stop()
        left = []
        while any(thread.is_alive() for thread in self._threads) or not self._done.empty():
            try:
                result = self._done.get(timeout=0.02)
            except Empty:
                continue
            if isinstance(result, Result):
                left.append(result)
        return left

    def close(self) -> None:
        """End all tools, whatever they found."""
        self.stop()

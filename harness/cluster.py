"""Run instances on the workers of a Dask cluster.

Dask runs a task again whose worker was lost. When the scheduler is lost, or was started
again, all that has no result yet is handed to it anew. Only the harness writes results, so
that an instance has one record however often it was run.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from harness.catalogue import Entry, relative, sha256
from harness.closing import Closing
from harness.job import Result, Setting
from harness.records import Limits, Record, Verdict
from racecar.errors import BadInput

try:
    from distributed import Client, Future, KilledWorker, as_completed
except ImportError as error:
    raise BadInput(
        f"--scheduler needs Dask ({error}); install it with: pip install 'closedlap[cluster]'"
    ) from None

from harness.worker import Task, install_on_worker, run_on_worker

#: How long (seconds) to wait for an answer of the scheduler, ...
CONNECT_S = 10.0
#: ... and for one that was there and is gone.
RECONNECT_S = 300.0
#: How often all may have to be handed over anew without one result in between.
MOST_ROUNDS = 10

_Lost = (CancelledError, OSError, TimeoutError)


def connect(address: str) -> Client:
    """Return a connection to a Dask scheduler; BadInput if none answers."""
    _silence()
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False, name="harness")
    except (OSError, ValueError) as error:
        raise BadInput(
            f"--scheduler {address}: no Dask scheduler answers there ({error})"
        ) from None


class ClusterJobs(Closing):
    """A Dask scheduler's workers; a context manager.

    cores_per_job: default a worker's cores divided by its threads; on_note: called with news.
    """

    def __init__(
        self,
        setting: Setting,
        address: str,
        cores_per_job: int | None,
        on_note: Callable[[str], None],
    ) -> None:
        self._setting, self._address = setting, address
        self._cores_per_job, self._on_note = cores_per_job, on_note
        self._scripts_sha256 = setting.tool.info().scripts_sha256
        self._hashes: dict[Path, str] = {}
        self._session = uuid.uuid4().hex
        self._futures: dict[str, Future] = {}
        self._client = connect(address)

    def install(self) -> tuple[str | None, bytes]:
        """Run install_tool.sh on one worker; return what is wrong, if anything, and its log."""
        self._on_note(self._workers())
        future = self._client.submit(install_on_worker, self._setting, pure=False)
        try:
            failure, log = future.result()
        except CancelledError:
            raise BadInput(f"--scheduler {self._address}: it was lost; start it again") from None
        except KilledWorker as error:
            raise BadInput(f"install_tool.sh: {error}") from None
        return failure, log

    def results(
        self, entries: Sequence[Entry], on_start: Callable[[Entry], None]
    ) -> Iterator[Result]:
        """Run instances; yield results as they come. What runs when is not known here."""
        waiting = {entry.id: entry for entry in entries}
        rounds = 0
        while waiting:
            rounds += 1
            try:
                for result in self._round([*waiting.values()]):
                    rounds = 0
                    del waiting[result.record.instance]
                    yield result
            except _Lost:
                if rounds >= MOST_ROUNDS:
                    raise BadInput(
                        f"--scheduler {self._address}: it forgets what it is given; see its log, "
                        "then go on with --resume"
                    ) from None
                self._reconnect()

    def _round(self, entries: Sequence[Entry]) -> Iterator[Result]:
        """Hand all instances over and yield results, until the scheduler is lost."""
        self._on_note(self._workers())
        by_key = {f"harness-{uuid.uuid4().hex}-{entry.id}": entry for entry in entries}
        tasks = [self._task(entry) for entry in by_key.values()]
        futures = self._client.map(run_on_worker, tasks, key=list(by_key), pure=False)
        self._futures = {str(future.key): future for future in futures}
        del futures  # so that a result is kept on its worker until it is read, no longer
        for future in as_completed(self._futures.values(), loop=self._client.loop):
            result = self._read(future, by_key[future.key])
            del self._futures[future.key]
            # Now, and not when the next one is read: what is not let go is run anew if its worker
            # is lost meanwhile.
            future.release()
            yield result

    def _task(self, entry: Entry) -> Task:
        for path in (entry.spec, entry.onnx):
            if path not in self._hashes:
                self._hashes[path] = sha256(path)
        return Task(
            self._session,
            self._setting,
            entry,
            self._hashes[entry.spec],
            self._hashes[entry.onnx],
            self._scripts_sha256,
            self._cores_per_job,
        )

    def _read(self, future: Future, entry: Entry) -> Result:
        try:
            result: Result = future.result()
        except KilledWorker as error:
            return self._killed(entry, error.allowed_failures + 1)
        except (BadInput, *_Lost):
            raise
        except Exception as error:
            raise BadInput(
                f"{entry.id}: a worker cannot run it ({type(error).__name__}: {error}); is the "
                "same version of the harness installed there?"
            ) from error
        return result

    def _killed(self, entry: Entry, times: int) -> Result:
        """Return the result of an instance that cost one worker after another.

        Most likely the tool used up the memory of its machine, or of its job on the cluster.
        """
        tool = self._setting.tool
        detail = f"its worker was lost {times} times while it ran"
        record = Record(
            instance=entry.id,
            category=entry.category,
            onnx=relative(entry.onnx, self._setting.root),
            spec=relative(entry.spec, self._setting.root),
            onnx_sha256=self._hashes[entry.onnx],
            spec_sha256=self._hashes[entry.spec],
            tool=tool.name,
            tool_version=tool.version,
            command=[],
            started_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
            prepare_time=0,
            run_time=0,
            cpu_time=0,
            max_memory_mib=0,
            result=str(Verdict.ERROR),
            verdict=Verdict.ERROR,
            detail=detail,
            limits=Limits(
                wall_s=entry.timeout,
                wall_end_s=entry.timeout,
                wall_kill_s=entry.timeout,
                prepare_wall_s=0,
                kept_by="nothing",
            ),
            log=f"{entry.id}.log",
        )
        return Result(record, b"")

    def _workers(self) -> str:
        with suppress(*_Lost):
            count = len(self._client.scheduler_info(n_workers=-1)["workers"])
            return f"{count} workers" if count else "no worker yet"
        return ""

    def _reconnect(self) -> None:
        """Wait until the scheduler answers again; BadInput if it doesn't."""
        self._on_note("the scheduler is lost")
        self._leave()
        give_up = time.monotonic() + RECONNECT_S
        while True:
            try:
                self._client = connect(self._address)
            except BadInput:
                if time.monotonic() > give_up:
                    raise BadInput(
                        f"--scheduler {self._address}: it has been lost for {RECONNECT_S:g} s; "
                        "start it again, then go on with --resume"
                    ) from None
                time.sleep(0.5)
            else:
                return

    def stop(self) -> list[Result]:
        """End all tools; return results that had come in and were not read."""
        left = []
        for future in list(self._futures.values()):
            if future.status == "finished":
                with suppress(Exception):
                    left.append(future.result(timeout=5))
        with suppress(Exception):
            self._client.cancel(list(self._futures.values()), force=True)
        self._futures = {}
        return left

    def close(self) -> None:
        """End all tools and leave the scheduler."""
        self.stop()
        self._leave()

    def _leave(self) -> None:
        self._futures = {}
        with suppress(Exception):
            self._client.close(timeout=2)


def _silence() -> None:
    """Keep from the person who waits what Dask logs of everything that is lost."""
    for name in [*logging.root.manager.loggerDict]:
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)

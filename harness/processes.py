"""The processes below this one: which they are, and what they use.

On Linux the kernel lists each process's children, so that a look costs as much as the tree
is large and not as much as the machine is busy. Elsewhere psutil looks.
"""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path

_LINUX = Path(f"/proc/self/task/{os.getpid()}/children").exists()
_TICK = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Process:
    """One process below us.

    cpu_s: user and system time of it and of the children that it has waited for; rss: bytes
    of memory in use, shared ones included; zombie: whether it has ended.
    """

    pid: int
    group: int
    zombie: bool
    cpu_s: float
    rss: int


def descendants() -> list[Process]:
    """Return every process below this one, parents before children."""
    if not _LINUX:
        return _by_psutil()
    found: list[Process] = []
    seen = {os.getpid()}
    to_visit = [os.getpid()]
    while to_visit:
        for pid in _children(to_visit.pop()):
            # A process may move up, to us, while we look.
            if pid in seen:
                continue
            seen.add(pid)
            process = _stat(pid)
            if process is not None:
                found.append(process)
                to_visit.append(pid)
    return found


def shared_out(processes: list[Process]) -> int:
    """Return the bytes in use by processes, each shared page counted once among its users.

    Costs milliseconds for a large process. A process that does not let us see counts in full.
    """
    total = 0
    for process in processes:
        total += process.rss
        try:
            with Path(f"/proc/{process.pid}/smaps_rollup").open("rb") as file:
                for line in file:
                    if line.startswith(b"Pss:"):
                        total += int(line.split()[1]) * 1024 - process.rss
                        break
        except OSError:
            continue
    return total


def unlinked_files(device: int) -> int:
    """Return the bytes on disk of files without a name that processes below us hold open.

    device: that of the file system whose files are counted. 0 where the system does not tell.
    """
    sizes: dict[int, int] = {}
    for process in descendants():
        try:
            opened = os.listdir(f"/proc/{process.pid}/fd")  # noqa: PTH208
        except OSError:
            continue
        for number in opened:
            try:
                info = os.stat(f"/proc/{process.pid}/fd/{number}")  # noqa: PTH116
            except OSError:
                continue
            if info.st_nlink == 0 and info.st_dev == device and stat.S_ISREG(info.st_mode):
                sizes[info.st_ino] = info.st_blocks * 512
    return sum(sizes.values())


def _children(pid: int) -> list[int]:
    children = []
    try:
        for thread in os.listdir(f"/proc/{pid}/task"):  # noqa: PTH208 (names are all we need)
            with open(f"/proc/{pid}/task/{thread}/children", "rb") as file:  # noqa: PTH123
                children += [int(word) for word in file.read().split()]
    except OSError:  # it has just ended
        pass
    return children


def _stat(pid: int) -> Process | None:
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:  # noqa: PTH123
            content = file.read()
    except OSError:
        return None
    # The name, in parentheses, may hold anything. After it: state, parent, group, ...
    fields = content[content.rindex(b")") + 2 :].split()
    ticks = sum(int(fields[i]) for i in (11, 12, 13, 14))
    return Process(
        pid=pid,
        group=int(fields[2]),
        zombie=fields[0] in (b"Z", b"X"),
        cpu_s=ticks / _TICK,
        rss=int(fields[21]) * _PAGE,
    )


def _by_psutil() -> list[Process]:
    import psutil  # noqa: PLC0415 (not needed on Linux)

    found = []
    for process in psutil.Process().children(recursive=True):
        try:
            zombie = process.status() == psutil.STATUS_ZOMBIE
            times = None if zombie else process.cpu_times()
            rss = 0 if zombie else process.memory_info().rss
            group = os.getpgid(process.pid)
        except (psutil.Error, OSError):
            continue
        cpu_s = sum(times[:4]) if times else 0.0
        found.append(Process(process.pid, group, zombie, cpu_s, rss))
    return found

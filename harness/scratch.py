"""A folder that a hostile tool wrote to: its size, and its removal.

The tool may have taken rights away, put folders into folders thousands deep, or a link in a
folder's place. No link is followed.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
import time

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW
#: Folders deeper than this are moved up before they are emptied, so that neither recursion nor
#: the number of open folders grows with their depth.
_DEEPEST = 50


def disk_usage(folder: str, until: float = float("inf")) -> float:
    """Return the bytes on disk of all files below a folder; infinite where that can't be told.

    It cannot where a path is longer than the system allows, or a folder may not be read.
    until: the time (time.monotonic) at which to return what has been seen so far.
    """
    total, to_visit = 0, [folder]
    while to_visit and time.monotonic() < until:
        try:
            with os.scandir(to_visit.pop()) as entries:
                for entry in entries:
                    try:
                        info = entry.stat(follow_symlinks=False)
                    except FileNotFoundError:
                        continue
                    total += info.st_blocks * 512
                    if stat.S_ISDIR(info.st_mode):
                        to_visit.append(entry.path)
        except (FileNotFoundError, NotADirectoryError):
            continue  # it has just been removed
        except OSError:
            return float("inf")
    return total


def remove(folder: str) -> None:
    """Remove a folder and all below it; what cannot be removed stays, without an error."""
    if not os.path.islink(folder):  # noqa: PTH114
        with contextlib.suppress(OSError):
            os.chmod(folder, stat.S_IRWXU)  # noqa: PTH101
    try:
        top = os.open(folder, _FOLDER)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(folder)  # noqa: PTH108 (a link in its place, or nothing)
        return
    try:
        moved = _Moved(top)
        _empty(top, moved, 0)
        while moved.names:
            _remove(top, moved.names.pop(), moved, 0)
    finally:
        os.close(top)
    with contextlib.suppress(OSError):
        os.rmdir(folder)  # noqa: PTH106


class _Moved:
    """Folders that lay too deep, moved up to the top one."""

    def __init__(self, top: int) -> None:
        self.names: list[str] = []
        self._top, self._prefix, self._count = top, secrets.token_hex(8), 0

    def take(self, folder: int, name: str) -> None:
        target = f"{self._prefix}{self._count}"
        self._count += 1
        os.rename(name, target, src_dir_fd=folder, dst_dir_fd=self._top)
        self.names.append(target)


def _empty(folder: int, moved: _Moved, depth: int) -> None:
    with os.scandir(folder) as listed:
        entries = list(listed)
    for entry in entries:
        with contextlib.suppress(OSError):
            if not entry.is_dir(follow_symlinks=False):
                os.unlink(entry.name, dir_fd=folder)
            elif depth < _DEEPEST:
                _remove(folder, entry.name, moved, depth + 1)
            else:
                moved.take(folder, entry.name)


def _remove(parent: int, name: str, moved: _Moved, depth: int) -> None:
    with contextlib.suppress(OSError):
        # Where its rights were taken away they are given back; it is no link, nothing runs here.
        os.chmod(name, stat.S_IRWXU, dir_fd=parent)
        fd = os.open(name, _FOLDER, dir_fd=parent)
        try:
            _empty(fd, moved, depth)
        finally:
            os.close(fd)
        os.rmdir(name, dir_fd=parent)

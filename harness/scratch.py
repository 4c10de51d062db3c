"""A folder that a hostile tool wrote to: its size, and its removal.

The tool may have taken rights away, put folders into folders thousands deep, or a link in a
folder's place. No link is followed.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat


def disk_usage(folder: str) -> float:
    """Return the bytes on disk of all files below a folder; infinite where that can't be told.

    It cannot where a path is longer than the system allows, or a folder may not be read.
    """
    total, to_visit = 0, [folder]
    while to_visit:
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
    """Remove a folder and all below it; what cannot be removed stays, without an error.

    Folders in it are moved up to the top one before they are emptied, so that neither paths
    nor recursion grow with their depth.
    """
    if os.path.islink(folder):  # noqa: PTH114
        with contextlib.suppress(OSError):
            os.unlink(folder)  # noqa: PTH108
        return
    moved = f"{secrets.token_hex(8)}-"
    number = 0
    to_empty = [folder]
    while to_empty:
        current = to_empty.pop()
        with contextlib.suppress(OSError):
            os.chmod(current, 0o700)  # noqa: PTH101
        try:
            with os.scandir(current) as listed:
                entries = list(listed)
        except OSError:
            continue
        for entry in entries:
            if not entry.is_dir(follow_symlinks=False):
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)  # noqa: PTH108
            elif current == folder:
                to_empty.append(entry.path)
            else:
                target = os.path.join(folder, f"{moved}{number}")  # noqa: PTH118
                number += 1
                with contextlib.suppress(OSError):
                    os.chmod(entry.path, 0o700)  # noqa: PTH101 (moving a folder writes to it)
                    os.rename(entry.path, target)  # noqa: PTH104
                    to_empty.append(target)
        if current != folder:
            with contextlib.suppress(OSError):
                os.rmdir(current)  # noqa: PTH106
    with contextlib.suppress(OSError):
        os.rmdir(folder)  # noqa: PTH106

"""Files that survive a crash, and files that a tool may have tampered with."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO


class NotPlain(OSError):
    """What lies at a path is not a plain file."""


def write_durable(path: Path, content: bytes) -> None:
    """Write a file so that it is complete or absent, whatever happens and whenever."""
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def open_plain(path: Path) -> BinaryIO:
    """Open a file for reading that a tool wrote; OSError unless it is a plain file.

    The tool may have left a link or a pipe: neither is followed, neither may block us.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise NotPlain(0, "it is not a plain file", str(path))
    return os.fdopen(fd, "rb")


def read_ends(path: Path, most: int) -> bytes:
    """Return a file's content, or where it is longer than ``most`` bytes its two ends."""
    try:
        with open_plain(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size <= most:
                return file.read(most)
            head = file.read(most // 2)
            file.seek(size - most // 2)
            tail = file.read(most // 2)
    except OSError:
        return b""
    left_out = size - len(head) - len(tail)
    return head + b"\n[... %d bytes left out by the harness ...]\n" % left_out + tail

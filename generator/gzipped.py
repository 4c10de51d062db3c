"""Compressed files that depend on their content only: no time and no name in them."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path

from racecar.errors import BadInput
from racecar.instance import read_text

#: More takes three times as long and saves 1 % of what we compress.
_LEVEL = 6


def gzipped(content: bytes) -> bytes:
    """Return a gzip file: the same content gives the same bytes with the same zlib."""
    buffer = io.BytesIO()
    with gzip.GzipFile("", "wb", compresslevel=_LEVEL, fileobj=buffer, mtime=0) as file:
        file.write(content)
    return buffer.getvalue()


def unpacked(path: Path) -> bytes:
    """Return what a gzip file holds; BadInput if it is missing or damaged."""
    try:
        return gzip.decompress(read_text(path))
    except (OSError, EOFError, zlib.error):
        raise BadInput(f"{path}: it is not a complete gzip file; make it again") from None

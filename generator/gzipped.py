"""Compressed files that depend on their content only: no time and no name in them."""

from __future__ import annotations

import gzip
import io


def gzipped(content: bytes) -> bytes:
    """Return a gzip file: the same content gives the same bytes with the same zlib."""
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, compresslevel=9, mtime=0) as file:
        file.write(content)
    return buffer.getvalue()

"""Printed text in three parts, so that what many instances share is printed once."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Document:
    """A file's text (or bytes, as a body alone).

    head, tail: what depends on an instance's ID and start box; body: pieces that depend on
    neither, made when they are asked for, once.
    """

    head: str = ""
    body: Iterator[str] | Iterator[bytes] = field(default_factory=lambda: iter(()))
    tail: str = ""

    def text(self) -> str:
        """Return the whole text."""
        return self.content(self.made_body(False), False).decode()

    def made_body(self, zipped: bool) -> bytes:
        """Return the body, compressed if asked."""
        pieces = [piece if isinstance(piece, bytes) else piece.encode() for piece in self.body]
        return _packed(b"".join(pieces), zipped)

    def content(self, body: bytes, zipped: bool) -> bytes:
        """Return the whole file, around a body that is made already.

        A compressed file is a row of gzip members, which every reader of gzip takes for one.
        """
        return _packed(self.head.encode(), zipped) + body + _packed(self.tail.encode(), zipped)


def _packed(content: bytes, zipped: bool) -> bytes:
    return gzip.compress(content, 6, mtime=0) if zipped and content else content

"""Printed text in three parts, so that what many instances share is printed once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from generator.gzipped import gzipped


@dataclass(frozen=True)
class Document:
    """A file's text (or bytes, as a body alone).

    head, tail: what depends on an instance's ID, start box and property; body: pieces that
    depend on none of them, made when they are asked for, once; None: all of it depends on them.
    """

    head: str = ""
    body: Iterator[str] | Iterator[bytes] | None = None
    tail: str = ""

    def text(self) -> str:
        """Return the whole text."""
        return self.content(self.made_body(False), False).decode()

    def made_body(self, zipped: bool) -> bytes:
        """Return the body, compressed if asked."""
        pieces = [
            piece if isinstance(piece, bytes) else piece.encode() for piece in self.body or ()
        ]
        return _packed(b"".join(pieces), zipped)

    def content(self, body: bytes, zipped: bool) -> bytes:
        """Return the whole file, around a body that is made already.

        A compressed file is a row of gzip members, which every reader of gzip takes for one.
        """
        return _packed(self.head.encode(), zipped) + body + _packed(self.tail.encode(), zipped)


#: Documents by the ending of the file's name.
Documents = Mapping[str, Document]


def shared(documents: Documents) -> dict[str, Document]:
    """Return the files that instances share which differ in start box and property.

    A document with a body and a tail is cut before the tail, and its ending gets ``.head``.
    """
    found = {}
    for ending, document in documents.items():
        if document.body is not None:
            name = f"{ending}.head" if document.tail else ending
            found[name] = Document(document.head, document.body)
    return found


def own(documents: Documents) -> dict[str, Document]:
    """Return the files of an instance that go with the shared ones; the tails are ``.tail``."""
    found = {}
    for ending, document in documents.items():
        if document.body is None:
            found[ending] = document
        elif document.tail:
            found[f"{ending}.tail"] = Document(document.tail)
    return found


def _packed(content: bytes, zipped: bool) -> bytes:
    return gzipped(content) if zipped and content else content

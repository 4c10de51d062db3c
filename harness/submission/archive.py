"""The archive of a submission: a deterministic .tar.gz, read with suspicion.

It is read in one pass and never unpacked to disk. Only plain files with known names, each once
and in sorted order, of bounded size, are accepted: no folder, link, device or extended header,
whatever it contains. What is unknown is refused before its content is read.
"""

from __future__ import annotations

import gzip
import io
import re
import tarfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Protocol

from harness.answer import LARGEST_WITNESS
from racecar.errors import BadInput

_MIB = 1 << 20
_WITNESS = re.compile(r"witnesses/[0-9a-f]{64}")
#: The names that may occur, and the most bytes (unpacked) that such a file may have.
_ALLOWED = (
    (re.compile(r"submission\.json"), 64 * _MIB),
    (re.compile(r"results\.json"), 16 * _MIB),
    (re.compile(r"runs/(?:0|[1-9]\d{0,2})/run\.json"), _MIB),
    (re.compile(r"runs/(?:0|[1-9]\d{0,2})/(?:records|checks)\.jsonl"), 256 * _MIB),
    (_WITNESS, LARGEST_WITNESS + 1),
)
#: Unpacked: of all files together, and of those that are kept in memory, all but the witnesses.
LARGEST_ARCHIVE, LARGEST_KEPT = 8 << 30, 256 * _MIB
_BLOCK = tarfile.BLOCKSIZE


class Readable(Protocol):
    """What is read from."""

    def read(self, size: int, /) -> bytes:
        """Return the next bytes, fewer only at the end."""


class Refused(Exception):
    """The archive is not a submission; the message says why."""


def write_archive(files: Iterable[tuple[str, bytes]], target: IO[bytes]) -> None:
    """Write files, sorted by name; the same files give the same bytes with the same zlib."""
    with (
        gzip.GzipFile(filename="", mode="wb", fileobj=target, compresslevel=9, mtime=0) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as archive,
    ):
        before = ""
        for name, content in files:
            assert name > before, "names must be sorted"
            before = name
            member = tarfile.TarInfo(name)
            member.size, member.mode, member.mtime = len(content), 0o644, 0
            archive.addfile(member, io.BytesIO(content))


def read_archive(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the names and contents of the files in their order.

    Raises Refused for whatever write_archive would not write, BadInput if there is no file.
    """
    try:
        with path.open("rb") as file, gzip.GzipFile(fileobj=file) as packed:
            yield from _members(packed)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise Refused(f"it is not a complete gzip file ({error})") from None
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None


def _members(packed: Readable) -> Iterator[tuple[str, bytes]]:
    before, total, kept = "", 0, 0
    while True:
        header = _read(packed, _BLOCK)
        if header == bytes(_BLOCK):
            _check_end(packed)
            return
        member = _header(header)
        if member.name <= before:
            what = "stands twice" if member.name == before else "is out of order"
            raise Refused(f"{_shown(member.name)} {what}")
        before = member.name
        total += member.size
        kept += 0 if _WITNESS.fullmatch(member.name) else member.size
        for size, largest in ((total, LARGEST_ARCHIVE), (kept, LARGEST_KEPT)):
            if size > largest:
                raise Refused(f"unpacked it is larger than {largest // _MIB} MiB")
        content = _read(packed, member.size)
        if any(_read(packed, -member.size % _BLOCK)):
            raise Refused(f"{member.name} is not filled up with zeros")
        yield member.name, content


def _header(block: bytes) -> tarfile.TarInfo:
    try:
        member = tarfile.TarInfo.frombuf(block, "ascii", "strict")
    except (tarfile.HeaderError, UnicodeDecodeError, ValueError) as error:
        raise Refused(f"it is not a tar archive ({error})") from None
    name = _shown(member.name)
    if member.type != tarfile.REGTYPE:
        raise Refused(f"{name} is not a plain file (type {member.type!r})")
    for allowed, largest in _ALLOWED:
        if allowed.fullmatch(member.name):
            if not 0 <= member.size <= largest:
                raise Refused(f"{name} has {member.size} bytes; {largest} are allowed")
            return member
    raise Refused(f"{name} is not a file of a submission")


def _check_end(packed: Readable) -> None:
    """Only zeros may follow, at most what tar fills a record up with."""
    rest = packed.read(2 * tarfile.RECORDSIZE + 1)
    if len(rest) > 2 * tarfile.RECORDSIZE or any(rest):
        raise Refused("something follows the end of the archive")


def _read(packed: Readable, size: int) -> bytes:
    content = packed.read(size)
    if len(content) < size:
        raise Refused("it ends in the middle of a file")
    return content


def _shown(name: str) -> str:
    return ascii(name if len(name) <= 80 else name[:80] + "...")

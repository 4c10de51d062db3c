"""Read a tool's result file: the first line is the answer, a witness follows ``sat``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from harness.files import open_plain
from harness.records import NO_RESULT, Verdict
from racecar.errors import BadInput

#: A longer witness (bytes) is not read: it is malformed.
LARGEST_WITNESS = 1 << 24
#: Only so much of the first line is looked at.
_LONGEST_LINE = 1000

#: What may stand in the first line. VNN-COMP's scoring also takes its older words.
_ANSWERS = {str(verdict): verdict for verdict in Verdict} | {
    "holds": Verdict.UNSAT,
    "violated": Verdict.SAT,
}


@dataclass(frozen=True)
class Answer:
    """A tool's answer.

    result: a result code; witness: what follows ``sat``, else None; detail: what is wrong
    with the file, where that is so.
    """

    result: str
    witness: bytes | None = None
    detail: str | None = None


def parse_answer(content: bytes) -> Answer:
    """Read the content of a result file.

    As in VNN-COMP, white space in the first line and upper case don't matter, and a first line
    that begins with ``timeout``, or with ``timed-out`` (the word of VNN-LIB 2.0), is a timeout.
    """
    first, _, rest = content.partition(b"\n")
    line = first[:_LONGEST_LINE].decode("ascii", errors="replace")
    word = re.sub(r"\s", "", line).lower()
    if not word:
        return Answer(NO_RESULT, detail="the first line of the result file is empty")
    late = word.startswith(("timeout", "timed-out"))
    verdict = Verdict.TIMEOUT if late else _ANSWERS.get(word)
    if verdict is None:
        detail = f"the first line of the result file is {line[:60]!r}, not an answer"
        return Answer(Verdict.ERROR, detail=detail)
    return Answer(str(verdict), witness=rest if verdict is Verdict.SAT else None)


def read_answer(path: Path) -> Answer:
    """Read a result file, whatever a tool may have put there."""
    try:
        with open_plain(path) as file:
            # One byte more than allowed, so that what is too large is seen to be.
            return parse_answer(file.read(_LONGEST_LINE + LARGEST_WITNESS + 1))
    except FileNotFoundError:
        return Answer(NO_RESULT, detail="there is no result file")
    except OSError as error:
        return Answer(NO_RESULT, detail=f"result file: {error.strerror}")


def read_witness(path: Path) -> bytes:
    """Return the witness in a file: the file itself, or what follows ``sat``; BadInput if bad."""
    try:
        with path.open("rb") as file:
            return witness_in(file.read(2 * LARGEST_WITNESS))
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None


def witness_in(content: bytes) -> bytes:
    """Return the witness in a file that is a witness, or a result file with one."""
    answer = parse_answer(content)
    if answer.witness is not None:
        return answer.witness
    return content if answer.result in (Verdict.ERROR, NO_RESULT) else b""

"""reference.csv and the witnesses beside it: rows as data, one reader and one writer."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from racecar.controller import write_whole
from racecar.errors import BadInput

REFERENCE, WITNESSES = "reference.csv", "reference_witnesses.jsonl"
VERDICTS = ("sat", "unsat", "unknown")
NUMBERS = ("margin_lower", "margin_upper", "time_s", "check_s")
#: What mends a broken table.
_ADVICE = "restore the file, or remove it and run `generator reference`"


@dataclass(frozen=True)
class Row:
    """What is known of one instance; numbers are text, empty where unknown.

    verdict: unsat, sat or unknown; margin_lower: proved (m); margin_upper: of the best run seen
    (m); method: in words; source: the instance whose certificate or witness it is; evidence: its
    sha256 (of the certificate file, or of the witness text); time_s: wall time of the search, if
    this instance was run; check_s: that of the check; versions: of the programs.
    """

    instance: str
    verdict: str
    margin_lower: str
    margin_upper: str
    method: str
    source: str
    evidence: str
    time_s: str
    check_s: str
    versions: str


COLUMNS = tuple(field.name for field in fields(Row))


def sha256(content: bytes) -> str:
    """Return the hash that stands as evidence."""
    return hashlib.sha256(content).hexdigest()


def read_rows(folder: Path) -> dict[str, Row]:
    """Return the rows of a category by instance, none without a file; BadInput if it is broken."""
    file = folder / REFERENCE
    try:
        lines = list(csv.reader(io.StringIO(file.read_text(encoding="utf-8")), strict=True))
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadInput(f"{file}: cannot be read ({error}); {_ADVICE}") from None
    if not lines or tuple(lines[0]) != COLUMNS:
        raise BadInput(f"{file}, line 1: the header must be {','.join(COLUMNS)}; {_ADVICE}")
    rows: dict[str, Row] = {}
    for number, line in enumerate(lines[1:], 2):
        if len(line) != len(COLUMNS):
            fault = f"{len(line)} columns, but the header has {len(COLUMNS)}"
        elif line[0] in rows:
            fault = f"a second row of {line[0]}"
        else:
            rows[line[0]] = Row(*line)
            fault = _fault(rows[line[0]])
        if fault:
            raise BadInput(f"{file}, line {number}: {fault}; {_ADVICE}")
    return rows


def _fault(row: Row) -> str:
    """Return what is wrong with a row's verdict or numbers; nothing if they are right."""
    if row.verdict not in VERDICTS:
        return f"verdict is {row.verdict!r}, not one of {', '.join(VERDICTS)}"
    for name in NUMBERS:
        text = getattr(row, name)
        try:
            if text and not math.isfinite(float(text)):
                raise ValueError
        except ValueError:
            return f"{name} is {text!r}, not a number"
    return ""


def read_witnesses(folder: Path) -> dict[str, str]:
    """Return the text of witnesses by instance, none without a file; BadInput if it is broken."""
    file = folder / WITNESSES
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
        found = [json.loads(line) for line in lines]
        return {str(line["instance"]): str(line["witness"]) for line in found}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{file}: cannot be read ({error})") from None


def write_category(folder: Path, rows: Iterable[Row], witnesses: Mapping[str, str]) -> None:
    """Write the results of a category and the witnesses that they name.

    The witnesses come first: where the rows are new, what they name is there.
    """
    rows = list(rows)
    named = {row.source for row in rows if row.verdict == "sat"}
    lines = [
        json.dumps({"instance": instance, "witness": witnesses[instance]}) + "\n"
        for instance in sorted(named)
    ]
    if lines:
        write_whole(folder / WITNESSES, "".join(lines).encode())
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(asdict(row).values() for row in rows)
    write_whole(folder / REFERENCE, text.getvalue().encode())
    if not lines:
        (folder / WITNESSES).unlink(missing_ok=True)

"""What a submission says, as typed data; its JSON Schema is published in docs/."""

from __future__ import annotations

import json
import unicodedata
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from harness.records import Data, Name, Record, RunInfo, Sha256, WitnessCheck
from harness.scoring import Row


def _plain(text: str) -> str:
    """Refuse what is not one line of plain text; it will be shown in tables and on web pages."""
    for character in text:
        if character in "<>" or (unicodedata.category(character)[0] in "CZ" and character != " "):
            raise ValueError(f"{character!a} may not stand in it; plain text on one line can")
    if text != text.strip():
        raise ValueError("it begins or ends with a space")
    return text


Text = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_plain)]
LongText = Annotated[str, Field(min_length=1, max_length=2000), AfterValidator(_plain)]
Link = Annotated[str, Field(pattern=r"^https?://[^\s<>\"']+$", max_length=500)]
Address = Annotated[str, Field(pattern=r"^[^\s<>@\"']+@[^\s<>@\"']+$", max_length=200)]
#: What --author takes: a name, and an affiliation if there is one.
Authors = Annotated[tuple[Text, ...], Field(min_length=1, max_length=100)]


class About(Data):
    """Who submits what."""

    tool: Name
    version: Text
    authors: Authors
    contact: Address
    url: Link | None = None
    description: LongText | None = None


class Packed(Data):
    """A file in the archive."""

    path: str
    size: int = Field(ge=0)
    sha256: Sha256


class Submission(Data):
    """The file submission.json: who, what, and the hash of every other file.

    run_folders names the runs; run i's records and checks lie in runs/i/. The machine, the limits
    and the tool of a run stand in its run.json, hashes of specs and networks in its records.
    """

    format: Literal["closedlap-submission"] = "closedlap-submission"
    version: Literal["1.0"] = "1.0"
    about: About
    harness_version: Text
    runs: int = Field(ge=1, le=1000)
    files: tuple[Packed, ...]


class Results(Data):
    """The file results.json: the score of the submission alone, as ``harness score`` counts it."""

    rows: tuple[Row, ...]


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of a submission's files, each under its name."""
    files: dict[str, type[Data]] = {
        "submission.json": Submission,
        "results.json": Results,
        "runs/N/run.json": RunInfo,
        "runs/N/records.jsonl, each line": Record,
        "runs/N/checks.jsonl, each line": WitnessCheck,
    }
    definitions: dict[str, Any] = {}
    named: dict[str, Any] = {}
    for name, kind in files.items():
        schema = kind.model_json_schema(ref_template="#/$defs/{model}")
        definitions |= schema.pop("$defs", {})
        named[name] = schema
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "A ClosedLap submission: the files in the archive",
        "type": "object",
        "properties": named,
        "$defs": definitions,
    }


def schema_text() -> str:
    """Return the JSON Schema as a file's text."""
    return json.dumps(json_schema(), indent=2, sort_keys=True) + "\n"

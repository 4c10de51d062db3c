"""What a tool's folder says of the tool: ``about.toml`` beside scripts, or ``tool.toml``.

``about.toml`` says what a tool is and what it reads. ``tool.toml`` serves a tool without scripts:
it also says how to call the tool and how its answer is found. Commands are lists of words, no
shell is involved; names in braces stand for what is known of the instance.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, ValidationError, model_validator

from harness.records import Data, Name, Seconds, Verdict
from racecar.errors import BadInput

DESCRIPTION, ABOUT = "tool.toml", "about.toml"
SCHEMA = "https://json-schema.org/draft/2020-12/schema"
SomeData = TypeVar("SomeData", bound=Data)
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")


class Format(StrEnum):
    """What a tool can read. The last four are made from JSON instances by ``prepare``."""

    JSON = "json"
    VNNLIB_1 = "vnnlib-1.0"
    VNNLIB_2 = "vnnlib-2.0"
    FLOWSTAR = "flowstar"
    SPACEEX = "spaceex"
    VERISIG = "verisig"
    AUTOMATON = "automaton"

    @property
    def given(self) -> Format:
        """The format in which the harness gives such an instance."""
        return self if self in (Format.JSON, Format.VNNLIB_1, Format.VNNLIB_2) else Format.JSON


class Status(StrEnum):
    """Whether the makers of this package ran the tool on real instances."""

    TESTED = "tested"
    UNTESTED = "untested"


def _regular(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"{text!r} is not a regular expression ({error})") from None
    return text


def _indexed(text: str) -> str:
    if not {"index", "value"} <= set(re.compile(_regular(text)).groupindex):
        raise ValueError(f"{text!r} must have the groups (?P<index>...) and (?P<value>...)")
    return text


#: A regular expression of Python's re; ^ and $ match at line ends.
Pattern = Annotated[str, AfterValidator(_regular)]
#: One with the named groups index and value.
IndexedPattern = Annotated[str, AfterValidator(_indexed)]
Words = Annotated[tuple[str, ...], Field(min_length=1)]
Word = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


class Accepts(Data):
    """What the tool can be asked. Anything else is answered ``unknown`` without starting it."""

    formats: Annotated[tuple[Format, ...], Field(min_length=1)]
    categories: tuple[str, ...] = Field(default=(), description="empty: all")


class Version(Data):
    """The tool's version: a fixed text, or what a command prints."""

    text: str | None = None
    command: Words | None = None
    pattern: Pattern = Field(default=r"(\S.*)", description="the first group is the version")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.text is None) == (self.command is None):
            raise ValueError("give either text or command")
        return self


class Program(Data):
    """A program or folder of the user's own installation, used as {name} in commands."""

    variable: str = Field(pattern=r"^[A-Z][A-Z0-9_]*$", description="environment variable: a path")
    default: str | None = Field(default=None, description="looked for in PATH if it is not set")
    help: str = Field(description="how to get it")


class Install(Data):
    """What install makes: a virtual environment of the tool's own, kept in a cache."""

    packages: tuple[Words, ...] = Field(
        default=(), description="arguments of pip install, one list after the other"
    )
    timeout_s: Seconds = 3000


class Step(Data):
    """One command. It ends well with one of these statuses."""

    command: Words
    stdin: str | None = Field(default=None, description="a file")
    environment: dict[str, str] = Field(default_factory=dict)
    status: tuple[int, ...] = (0,)


class Run(Step):
    """The command that decides. {timeout} is the limit less ``reserve`` seconds, or half of it."""

    reserve: Seconds = 1.0


class Rule(Data):
    """Gives a verdict if every pattern of ``all`` is found and none of ``none``."""

    verdict: Verdict
    all: Annotated[tuple[Pattern, ...], Field(min_length=1)]
    none: tuple[Pattern, ...] = ()


class Result(Data):
    """Where the answer is.

    vnncomp: the tool writes {results} as VNN-COMP's tools do, witness included. rules: the
    first rule that holds for the text gives the verdict, and if none does it is ``otherwise``.
    """

    form: Literal["vnncomp", "rules"]
    file: str | None = Field(default=None, description="its text; absent: what the tool prints")
    rules: tuple[Rule, ...] = ()
    otherwise: Verdict = Verdict.UNKNOWN

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.form == "rules") != bool(self.rules):
            raise ValueError("form 'rules' needs rules, and only that form has them")
        if self.file is not None and self.form == "vnncomp":
            raise ValueError("file goes with form 'rules'; the tool writes {results}")
        if self.otherwise in (Verdict.SAT, Verdict.UNSAT):
            raise ValueError("otherwise: sat and unsat must be said by a rule")
        return self


class Witness(Data):
    """Where the witness is after ``sat``, if the tool does not write it as VNN-COMP's tools do.

    text: the group ``witness`` of the pattern (all of the text without one) is the witness.
    values: every match of ``inputs`` is the value of an input of the network; it is written in
    the specification's own syntax, with the outputs that onnxruntime computes.
    """

    form: Literal["text", "values"]
    file: str | None = Field(default=None, description="its text; absent: what the tool prints")
    pattern: Pattern | None = None
    inputs: IndexedPattern | None = None
    check: bool = Field(
        default=False, description="judge it first, and say unknown if it earns nothing"
    )

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.form == "values") != (self.inputs is not None):
            raise ValueError("form 'values' needs inputs, and only that form has them")
        if self.pattern is not None and self.form != "text":
            raise ValueError("pattern goes with form 'text'")
        if self.pattern and "witness" not in re.compile(self.pattern).groupindex:
            raise ValueError("pattern must have a group (?P<witness>...)")
        return self


class About(Data):
    """What a tool is, ``about.toml`` beside its scripts."""

    summary: Annotated[str, Field(min_length=1)]
    homepage: str | None = None
    status: Status = Status.UNTESTED
    notes: str = Field(default="", description="what a user must know about its answers")
    accepts: Accepts


class Description(About):
    """A tool without scripts, ``tool.toml`` in its folder."""

    format: Literal["closedlap-tool-1.0"]
    name: Name
    version: Version | None = None
    programs: dict[Word, Program] = Field(default_factory=dict)
    install: Install = Install()
    prepare: tuple[Step, ...] = ()
    run: Run
    result: Result
    witness: Witness | None = None

    @model_validator(mode="after")
    def _placeholders(self) -> Self:
        taken = set(self.programs) & set(PLACEHOLDERS)
        if taken:
            raise ValueError(f"programs.{taken.pop()}: the name is taken; choose another")
        for place, text, known in self._templates():
            unknown = placeholders(text) - known
            if unknown:
                raise ValueError(
                    f"{place}: {{{unknown.pop()}}} is unknown; choose from "
                    + ", ".join(f"{{{name}}}" for name in sorted(known))
                )
        says_sat = any(rule.verdict is Verdict.SAT for rule in self.result.rules)
        if says_sat and self.witness is None:
            raise ValueError("witness: a tool that answers sat must give a witness; say where")
        if self.witness is not None and not says_sat:
            raise ValueError("witness: no rule of result says sat")
        return self

    def _templates(self) -> Iterator[tuple[str, str, set[str]]]:
        """Yield all texts with placeholders: where they stand, and which they may have."""
        installed = {"folder", "python", *self.programs}
        if self.install.packages:
            installed.add("bin")
        instance = installed | {"onnx", "spec", "category", "id", "work"}
        everything = instance | {"results", "limit", "timeout"}
        for word in (self.version and self.version.command) or ():
            yield "version.command", word, installed
        for number, step in enumerate(self.prepare):
            for word in _words(step):
                yield f"prepare.{number}", word, instance
        for word in _words(self.run):
            yield "run", word, everything
        yield "result.file", self.result.file or "", everything
        yield "witness.file", (self.witness and self.witness.file) or "", everything


#: What names in braces stand for.
PLACEHOLDERS = {
    "onnx": "the network",
    "spec": "the specification",
    "category": "its category",
    "id": "the instance's ID",
    "results": "the result file to write (form vnncomp)",
    "limit": "the time limit in seconds",
    "timeout": "the same less run.reserve, so that the tool can still answer; whole seconds",
    "work": "the scratch folder, in which the commands run",
    "folder": "the tool's folder",
    "python": "the Python that runs the harness",
    "bin": "the programs of the tool's own virtual environment",
}


def own_files(tool: Description) -> list[str]:
    """Return the names of files in the tool's folder that its commands name."""
    steps = [*tool.prepare, tool.run]
    words = [word for step in steps for word in _words(step)]
    return sorted(
        {word.removeprefix("{folder}/") for word in words if word.startswith("{folder}/")}
    )


def _words(step: Step) -> Iterator[str]:
    yield from step.command
    yield step.stdin or ""
    yield from step.environment.values()


def placeholders(text: str) -> set[str]:
    """Return the names in braces."""
    return set(_PLACEHOLDER.findall(text))


def fill(text: str, values: Mapping[str, str]) -> str:
    """Return the text with every {name} replaced; KeyError for one that has no value."""
    return _PLACEHOLDER.sub(lambda match: values[match[1]], text)


def load_description(path: Path) -> Description:
    """Read a ``tool.toml``; BadInput says what is wrong and where."""
    return _load(path, Description)


def load_about(path: Path) -> About:
    """Read an ``about.toml``; BadInput says what is wrong and where."""
    return _load(path, About)


def _load(path: Path, kind: type[SomeData]) -> SomeData:
    try:
        data = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadInput(f"{path}: not TOML: {error}") from None
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise BadInput(
            f"{path}: {_complaint(error)}; docs/tool-interface.md has an example"
        ) from None


def _complaint(error: ValidationError) -> str:
    """Return the first thing that is wrong; of a misspelt key also where it stands."""
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        message = "there is no such key"
    more = error.error_count() - 1
    return (f"{place}: " if place else "") + message + (f" (and {more} more)" if more else "")


def description_schema() -> dict[str, Any]:
    """Return the JSON Schema of a description."""
    schema = Description.model_json_schema()
    return {"$schema": SCHEMA, **schema, "title": "closedlap-tool-1.0"}

"""Runs a described tool as if it had VNN-COMP's scripts.

    python -m harness.adapter install  FOLDER v1
    python -m harness.adapter prepare  FOLDER v1 CATEGORY ONNX SPEC
    python -m harness.adapter run      FOLDER v1 CATEGORY ONNX SPEC RESULTS TIMEOUT

Before all that may stand ``--cache DIR``: where environments are kept, whatever HOME is now. FOLDER
holds ``tool.toml``. What the tool prints is passed on as it comes. A command that ends with another
status than described ends the adapter with that status; nothing that it printed is believed.
"""

from __future__ import annotations

import gzip
import json
import os
import re
import select
import subprocess
import sys
import threading
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from harness.description import (
    DESCRIPTION,
    Description,
    Format,
    Result,
    Step,
    Witness,
    fill,
    load_description,
)
from harness.environments import CACHE_VARIABLE
from harness.files import open_plain
from harness.installed import install, installed_values
from harness.records import Verdict
from racecar.errors import BadInput

#: A longer text (bytes) is not looked at: a part of it might lack what speaks against a verdict.
MOST_TEXT = 1 << 26
_COMMENT = re.compile(r";.*")
_VERSION_2 = re.compile(r"\(\s*vnnlib-version\s*<\s*2\.\d+\s*>\s*\)")
_USAGE = "usage: python -m harness.adapter install|prepare|run FOLDER v1 [CATEGORY ONNX SPEC ...]"


class Refused(Exception):
    """The tool cannot be asked this; the message says why."""


class Ended(Exception):
    """A command ended with a status that is not a good one."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status if status >= 0 else 128 - status


@dataclass(frozen=True)
class Question:
    """What the scripts are told of an instance."""

    category: str
    onnx: Path
    spec: Path

    def format(self) -> Format:
        """Return the format of the specification."""
        if self.spec.suffix == ".json":
            return Format.JSON
        text = _COMMENT.sub("", self.spec.read_text("utf-8", errors="replace"))
        return Format.VNNLIB_2 if _VERSION_2.search(text) else Format.VNNLIB_1

    def id(self) -> str:
        """Return the instance's ID: what its JSON says, else the name of the file."""
        if self.spec.suffix == ".json":
            return str(json.loads(self.spec.read_text("utf-8")).get("id", self.spec.stem))
        return self.spec.stem

    def unpacked(self) -> Question:
        """Return the question with files that are not gzipped, copies where they were.

        The copies lie in the scratch folder; prepare makes them, and run finds them there.
        """
        return replace(self, onnx=_unpack(self.onnx), spec=_unpack(self.spec))


def _unpack(path: Path) -> Path:
    if path.suffix != ".gz":
        return path
    copy = Path.cwd() / "unpacked" / path.stem
    if not copy.exists():
        try:
            content = gzip.decompress(path.read_bytes())
        except (OSError, EOFError, zlib.error) as error:
            raise BadInput(f"{path}: cannot be unpacked ({error})") from None
        copy.parent.mkdir(exist_ok=True)
        copy.write_bytes(content)
    return copy


def check_accepted(tool: Description, question: Question) -> None:
    """Raise Refused if the tool cannot be asked."""
    given = question.format()
    known = list(dict.fromkeys(format_.given for format_ in tool.accepts.formats))
    if given not in known:
        raise Refused(f"{tool.name} reads {', '.join(known)}, and this is {given}")
    categories = tool.accepts.categories
    if categories and question.category not in categories:
        raise Refused(f"{tool.name} is for {', '.join(categories)}, not {question.category}")


def instance_values(question: Question) -> dict[str, str]:
    """Return what the placeholders of an instance stand for."""
    return {
        "category": question.category,
        "onnx": str(question.onnx),
        "spec": str(question.spec),
        "id": question.id(),
        "work": str(Path.cwd()),
    }


def prepare(tool: Description, folder: Path, question: Question) -> None:
    """Take the steps before the clock starts."""
    check_accepted(tool, question)
    values = installed_values(tool, folder) | instance_values(question)
    for step in tool.prepare:
        call(step, values)


def run(tool: Description, folder: Path, question: Question, results: Path, limit: float) -> None:
    """Ask the tool and write the result file."""
    try:
        check_accepted(tool, question)
    except Refused as refused:
        print(f"unknown: {refused}", flush=True)
        results.write_text(f"{Verdict.UNKNOWN}\n", "utf-8")
        return
    # Whole seconds: many tools take no others.
    timeout = max(1, int(max(limit - tool.run.reserve, limit / 2)))
    times = {"limit": f"{limit:g}", "timeout": str(timeout), "results": str(results)}
    values = installed_values(tool, folder) | instance_values(question) | times
    printed = call(tool.run, values)
    if tool.result.form == "vnncomp":
        return
    verdict = judge(tool.result, _found(tool.result.file, values, printed))
    answer = f"{verdict}\n"
    if verdict is Verdict.SAT:
        assert tool.witness is not None
        text = _found(tool.witness.file, values, printed)
        answer += find_witness(tool.witness, text, question)
        if tool.witness.check:
            answer = _checked(answer, question)
    results.write_text(answer, "utf-8")


def _checked(answer: str, question: Question) -> str:
    """Return the answer, or unknown where the judge of witnesses would not credit its witness."""
    # Slow to import, and needed for a witness only.
    from harness.catalogue import Entry  # noqa: PLC0415
    from harness.checks import judge_entry  # noqa: PLC0415

    entry = Entry(question.id(), question.category, question.onnx, question.spec, 0.0)
    check = judge_entry(entry, answer.partition("\n")[2].encode())
    if check.credited:
        return answer
    print(f"unknown: it says sat, but its witness is {check.outcome}: {check.message}", flush=True)
    return f"{Verdict.UNKNOWN}\n"


def judge(result: Result, text: str) -> Verdict:
    """Return the verdict of the first rule that holds for the text."""
    for rule in result.rules:
        found = all(re.search(pattern, text, re.MULTILINE) for pattern in rule.all)
        if found and not any(re.search(pattern, text, re.MULTILINE) for pattern in rule.none):
            return rule.verdict
    return result.otherwise


def find_witness(witness: Witness, text: str, question: Question) -> str:
    """Return the witness as it stands after ``sat``; BadInput if it is not to be found."""
    if witness.form == "text":
        if witness.pattern is None:
            return text
        match = re.search(witness.pattern, text, re.MULTILINE)
        if match is None:
            raise BadInput("it says sat, but the witness is not where the description says")
        return match["witness"]
    assert witness.inputs is not None
    found = {
        int(match["index"]): float(match["value"])
        for match in re.finditer(witness.inputs, text, re.MULTILINE)
    }
    if sorted(found) != list(range(len(found))) or not found:
        raise BadInput(f"it says sat, but gives the inputs {sorted(found)} of the network only")
    # Slow to import, and needed for a witness only.
    from harness.counterexample import counterexample_for  # noqa: PLC0415

    inputs = [found[index] for index in range(len(found))]
    return counterexample_for(question.onnx, question.spec, inputs)


def call(step: Step, values: Mapping[str, str]) -> bytes:
    """Run a command; return what it printed, up to a little more than MOST_TEXT. Raises Ended."""
    command = [fill(word, values) for word in step.command]
    environment = {name: fill(text, values) for name, text in step.environment.items()}
    source = Path(fill(step.stdin, values)) if step.stdin else Path(os.devnull)
    try:
        with source.open("rb") as stdin:
            process = subprocess.Popen(
                command,
                stdin=stdin,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=os.environ | environment,
            )
    except OSError as error:
        raise BadInput(f"{command[0]}: cannot be started ({error.strerror})") from None
    assert process.stdout is not None
    tee = Tee(process.stdout)
    status = process.wait()
    printed = tee.finish()
    if status not in step.status:
        raise Ended(status)
    return printed


class Tee:
    """Passes on what a process prints, and keeps it."""

    #: A process that outlives the command may hold its output open; it is waited for so long (s).
    PATIENCE_S = 0.5

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._kept = bytearray()
        self._thread = threading.Thread(target=self._pump, daemon=True)
        self._thread.start()

    def _pump(self) -> None:
        while chunk := os.read(self._stream.fileno(), 1 << 16):
            if len(self._kept) <= MOST_TEXT:
                self._kept += chunk
            os.write(sys.stdout.fileno(), chunk)

    def finish(self) -> bytes:
        """Return all that was printed, when the command has ended."""
        self._thread.join(self.PATIENCE_S)
        while self._thread.is_alive() and select.select([self._stream], [], [], 0)[0]:
            self._thread.join(0.01)
        return bytes(self._kept)


def _found(file: str | None, values: Mapping[str, str], printed: bytes) -> str:
    """Return the text of a file that the tool wrote, nothing if there is none; or the output."""
    content, what = printed, "what it prints"
    if file is not None:
        what = fill(file, values)
        try:
            with open_plain(Path(what)) as written:
                content = written.read(MOST_TEXT + 1)
        except OSError:
            print(f"there is no file {what}", flush=True)
            return ""
    if len(content) > MOST_TEXT:
        raise BadInput(f"{what} is longer than {MOST_TEXT} bytes, too long to be looked at")
    return content.decode("utf-8", errors="replace")


def main(arguments: Sequence[str]) -> int:
    """Take one step; return the exit status."""
    if arguments[:1] == ["--cache"]:
        os.environ[CACHE_VARIABLE] = arguments[1]
        arguments = arguments[2:]
    counts = {"install": 0, "prepare": 3, "run": 5}
    if len(arguments) < 3 or len(arguments) != 3 + counts.get(arguments[0], -1):
        print(_USAGE, file=sys.stderr)
        return 2
    action, folder = arguments[0], Path(arguments[1])
    try:
        tool = load_description(folder / DESCRIPTION)
        if action == "install":
            install(tool)
            return 0
        question = Question(arguments[3], Path(arguments[4]), Path(arguments[5])).unpacked()
        if action == "prepare":
            prepare(tool, folder, question)
        else:
            run(tool, folder, question, Path(arguments[6]), float(arguments[7]))
    except Refused:
        return 0  # run says so, with a result
    except Ended as ended:
        print(f"the command ended with status {ended.status}", file=sys.stderr)
        return ended.status
    except BadInput as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

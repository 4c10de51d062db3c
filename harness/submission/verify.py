"""Judge a submission again, from its own files and the benchmarks folder.

Nothing that it says is believed: hashes are compared, every witness is judged anew, the records
are held against the instances and against each other, the results are counted again.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TypeVar

from harness.catalogue import (
    Entry,
    in_all_versions,
    load_everything,
    plain_name,
    relative,
    sha256,
)
from harness.checks import judge_entry
from harness.records import Data, Record, RunInfo, Verdict, WitnessCheck
from harness.submission.archive import Refused, read_archive
from harness.submission.model import About, Results, Submission
from harness.submission.pack import results_of
from racecar.data import parse_data
from racecar.errors import BadInput

SUBMISSION, RESULTS = "submission.json", "results.json"
#: After so many lines of a file that cannot be read the others are not.
MOST_BAD_LINES = 20
_WITNESS = re.compile(r"witnesses/([0-9a-f]{64})")
AnyData = TypeVar("AnyData", bound=Data)


@dataclass(frozen=True)
class Problem:
    """What is wrong with a submission, and where."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


@dataclass(frozen=True)
class Verified:
    """The outcome; about and checked (records, each with a fresh check) as far as readable.

    witnesses: how many were judged anew.
    """

    problems: tuple[Problem, ...]
    about: About | None = None
    infos: tuple[RunInfo, ...] = ()
    checked: tuple[tuple[Record, WitnessCheck | None], ...] = ()
    witnesses: int = 0


def verify_submission(path: Path, root: Path) -> Verified:
    """Verify the submission in a file; root: the benchmarks folder.

    BadInput if there is no such file, or if the benchmarks cannot be used.
    """
    files: dict[str, bytes] = {}
    work: _Verification | None = None
    try:
        for name, content in read_archive(path):
            witness = _WITNESS.fullmatch(name)
            if witness is None:
                files[name] = content
                continue
            # Names are sorted: all other files come before the witnesses.
            if work is None:
                work = _Verification(files, root)
            work.take_witness(name, content, witness[1])
        if work is None:
            work = _Verification(files, root)
    except Refused as error:
        return Verified((Problem(path.name, f"refused: {error}"),))
    return work.finish()


@dataclass
class _Run:
    info: RunInfo
    records: list[Record]
    checks: dict[str, WitnessCheck] = field(default_factory=dict)


class _Verification:
    """What is known while the archive is read."""

    def __init__(self, files: dict[str, bytes], root: Path) -> None:
        self._root = root
        self._problems: list[Problem] = []
        if SUBMISSION not in files:
            raise Refused(f"it holds no {SUBMISSION}")
        try:
            self._submission = parse_data(Submission, files[SUBMISSION])
        except BadInput as error:
            raise Refused(f"{SUBMISSION}: {_one_line(str(error))}") from None
        self._listed = {file.path: file for file in self._submission.files}
        self._seen: set[str] = set()
        for name, content in files.items():
            if name != SUBMISSION:
                self._compare(name, content)
        self._runs = [run for n in range(self._submission.runs) if (run := self._run(n, files))]
        expected = {SUBMISSION, RESULTS} | {
            f"runs/{n}/{part}"
            for n in range(self._submission.runs)
            for part in ("run.json", "records.jsonl", "checks.jsonl")
        }
        for name in sorted(set(files) - expected):
            self._note(name, f"{SUBMISSION} speaks of {self._submission.runs} runs only")
        self._results = self._parse(Results, RESULTS, files.get(RESULTS))
        self._entries = {entry.id: entry for entry in load_everything(root)}
        self._hashes: dict[Path, str] = {}
        #: By sha256 of the witness: who must be judged with it.
        self._waiting: dict[str, list[tuple[Record, WitnessCheck, Entry]]] = defaultdict(list)
        self._fresh: dict[str, WitnessCheck] = {}
        self._check_records()

    def _note(self, where: str, what: str) -> None:
        self._problems.append(Problem(_one_line(where), _one_line(what)))

    def _compare(self, name: str, content: bytes) -> None:
        self._seen.add(name)
        listed = self._listed.get(name)
        if listed is None:
            self._note(name, f"{SUBMISSION} does not list it")
        elif (listed.size, listed.sha256) != (len(content), hashlib.sha256(content).hexdigest()):
            self._note(name, f"it is not the file that {SUBMISSION} lists: another size or sha256")

    def _parse(self, kind: type[AnyData], name: str, content: bytes | None) -> AnyData | None:
        if content is None:
            self._note(name, "it is missing")
            return None
        try:
            return parse_data(kind, content)
        except BadInput as error:
            self._note(name, str(error))
            return None

    def _lines(self, kind: type[AnyData], name: str, content: bytes | None) -> list[AnyData]:
        if content is None:
            self._note(name, "it is missing")
            return []
        found: list[AnyData] = []
        bad = 0
        for number, line in enumerate(io.BytesIO(content), 1):
            data = self._parse(kind, f"{name}, line {number}", line)
            if data is not None:
                found.append(data)
            elif (bad := bad + 1) == MOST_BAD_LINES:
                self._note(name, "so many lines are wrong that the others were not read")
                break
        return found

    def _run(self, number: int, files: dict[str, bytes]) -> _Run | None:
        folder = f"runs/{number}"
        info = self._parse(RunInfo, f"{folder}/run.json", files.get(f"{folder}/run.json"))
        records, checks = f"{folder}/records.jsonl", f"{folder}/checks.jsonl"
        found = self._lines(Record, records, files.get(records))
        run = _Run(info, found) if info else None
        for check in self._lines(WitnessCheck, checks, files.get(checks)):
            if run and run.checks.setdefault(check.instance, check) is not check:
                self._note(checks, f"{check.instance} has two checks")
        return run

    def _check_records(self) -> None:
        seen: set[str] = set()
        for run in self._runs:
            self._check_tool(run)
            for record in run.records:
                if record.instance in seen:
                    self._note(record.instance, "it has two results")
                seen.add(record.instance)
                self._check_record(run, record)
            strange = set(run.checks) - {r.instance for r in run.records if _is_sat(r)}
            for instance in sorted(strange):
                self._note(instance, "there is a witness check, but no result sat")

    def _check_tool(self, run: _Run) -> None:
        about, tool = self._submission.about, run.info.tool
        if tool.name != about.tool or tool.version not in (None, about.version):
            self._note(
                f"run of {tool.name} {tool.version}",
                f"the submission is of {about.tool} {about.version}",
            )

    def _check_record(self, run: _Run, record: Record) -> None:
        for what in _inconsistencies(record, run.info):
            self._note(record.instance, what)
        entry = self._entry(record)
        if entry is None:
            return
        asked = entry.timeout if run.info.timeout_s is None else run.info.timeout_s
        if record.limits.wall_s > entry.timeout:
            had, has = record.limits.wall_s, entry.timeout
            self._note(record.instance, f"the tool had {had:g} s; the instance allows {has:g} s")
        elif record.limits.wall_s != asked:
            self._note(record.instance, f"its limit is {record.limits.wall_s:g} s, not {asked:g} s")
        if not _is_sat(record):
            return
        check = run.checks.get(record.instance)
        if check is None:
            self._note(record.instance, "the result is sat, but there is no witness check")
            return
        if (check.spec_sha256, check.onnx_sha256) != (record.spec_sha256, record.onnx_sha256):
            self._note(record.instance, "its witness check is of other files than its record")
        self._waiting[check.witness_sha256].append((record, check, entry))

    def _entry(self, record: Record) -> Entry | None:
        """Return the instance that a record is of, if it is one of the benchmarks as they are."""
        listed = self._entries.get(record.instance)
        if listed is None or listed.category != record.category:
            self._note(record.instance, f"the benchmarks have none such in {record.category}")
            return None
        entry = next(
            (e for e in in_all_versions(listed) if self._is_named(e.spec, record.spec)),
            None,
        )
        if entry is None or not self._is_named(entry.onnx, record.onnx):
            self._note(record.instance, "its files are not those that the benchmarks name")
            return None
        for path, said in ((entry.spec, record.spec_sha256), (entry.onnx, record.onnx_sha256)):
            if path not in self._hashes:
                self._hashes[path] = sha256(path)
            if self._hashes[path] != said:
                self._note(record.instance, f"it was run on another {path.name} (sha256 differs)")
                return None
        return entry

    def _is_named(self, path: Path, name: str) -> bool:
        """Whether a record's name is that of a file, packed or not."""
        return plain_name(relative(path, self._root)) == plain_name(name)

    def take_witness(self, name: str, content: bytes, digest: str) -> None:
        """Judge a witness for every record that it belongs to."""
        self._compare(name, content)
        if hashlib.sha256(content).hexdigest() != digest:
            self._note(name, "its sha256 is not its name")
            return
        waiting = self._waiting.pop(digest, None)
        if waiting is None:
            self._note(name, "no result has this witness")
        for record, said, entry in waiting or ():
            fresh = judge_entry(entry, content)
            self._fresh[record.instance] = fresh
            if fresh.outcome is not said.outcome:
                self._note(
                    record.instance,
                    f"its witness is said to be {said.outcome}, but is {fresh.outcome} "
                    f"({fresh.message})",
                )

    def finish(self) -> Verified:
        """Return the outcome when all files have been read."""
        for digest, waiting in self._waiting.items():
            for record, _, _ in waiting:
                self._note(record.instance, f"its witness {digest[:12]}... is missing")
        for name in sorted(set(self._listed) - self._seen):
            self._note(name, f"{SUBMISSION} lists it, but it is missing")
        unique = {record.instance: record for run in self._runs for record in run.records}
        checked = [(record, self._fresh.get(record.instance)) for record in unique.values()]
        if not checked:
            self._note(SUBMISSION, "it has no results")
        elif self._results is not None and self._results != results_of(checked):
            self._note(RESULTS, "counted again, the results are others")
        return Verified(
            tuple(self._problems),
            self._submission.about,
            tuple(run.info for run in self._runs),
            tuple(checked),
            len(self._fresh),
        )


def _is_sat(record: Record) -> bool:
    return record.verdict is Verdict.SAT


def _inconsistencies(record: Record, info: RunInfo) -> Iterator[str]:
    if (record.tool, record.tool_version) != (info.tool.name, info.tool.version):
        yield f"it is a result of {record.tool} {record.tool_version}, in a run of another tool"
    for when, text in (("started_at", record.started_at), ("created_at", info.created_at)):
        try:
            datetime.fromisoformat(text)
        except ValueError:
            yield f"{when} is {text[:40]!r}, not a time in ISO 8601"


def _one_line(text: str, longest: int = 400) -> str:
    """Return text that may be an attacker's as one line without what a terminal would obey."""
    line = "".join(c if c.isprintable() else "?" for c in text)
    return line if len(line) <= longest else line[:longest] + "..."


def group(problems: Sequence[Problem]) -> list[tuple[str, list[str]]]:
    """Return each kind of problem with the places that have it."""
    places: dict[str, list[str]] = defaultdict(list)
    for problem in problems:
        places[problem.what].append(problem.where)
    return list(places.items())

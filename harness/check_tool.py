"""Try a tool on tiny instances with known answers, and say in plain words what is wrong."""

from __future__ import annotations

import stat
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from harness.checks import check_entry
from harness.description import Format
from harness.records import (
    NO_RESULT,
    PREPARE_ERROR,
    PREPARE_TIMEOUT,
    RUN_ERROR,
    RUN_TIMEOUT,
    Record,
    Verdict,
    WitnessOutcome,
)
from harness.runner import Finished, Runner
from harness.tiny import Tiny, make_tiny
from harness.tool import INSTALL, PREPARE, RUN, Tool
from racecar.errors import BadInput

#: So many of the last lines of a tool's output are shown where it failed.
_LOG_LINES = 5
_GIVEN = (Format.JSON, Format.VNNLIB_1, Format.VNNLIB_2)


class Level(StrEnum):
    """How bad a finding is."""

    GOOD = "good"
    DOUBT = "doubt"
    WRONG = "wrong"


@dataclass(frozen=True)
class Finding:
    """What was seen: where, what it is, and what to do about it (nothing if it is good).

    output: the last lines that the tool printed, where they may help.
    """

    level: Level
    where: str
    what: str
    advice: str = ""
    output: str = ""


def check_tool(
    tool: Tool, formats: Sequence[Format], timeout: float, install: bool = True
) -> Iterator[Finding]:
    """Try a tool; yield what is seen as it is seen.

    formats: of the instances to try, empty for those that the tool says it reads, or all.
    timeout: seconds for each.
    """
    broken = list(_scripts(tool))
    yield from broken
    if any(finding.level is Level.WRONG for finding in broken):
        return
    if not formats:
        formats = tool.about.accepts.formats if tool.about else _GIVEN
    # Not below the folder for temporary files that the tool is given: it is not to write here.
    with tempfile.TemporaryDirectory(prefix="closedlap-check-") as folder:
        root = Path(folder) / "set"
        tiny = make_tiny(root, formats, timeout)
        with Runner(tool, None) as runner:
            if install and tool.has_install:
                failure, log = runner.install()
                if failure:
                    advice = "run it by hand and mend it"
                    yield Finding(Level.WRONG, INSTALL, failure, advice, _end(log))
                    return
            for each in tiny:
                yield from _try(tool, runner, each, [root, tool.folder, Path.cwd()])


def _scripts(tool: Tool) -> Iterator[Finding]:
    """Look at the scripts without running them."""
    if tool.description is not None:
        return
    for name in (INSTALL, PREPARE, RUN):
        path = tool.folder / name
        if not path.is_file():
            continue
        if b"\r\n" in path.read_bytes():
            yield Finding(
                Level.WRONG,
                name,
                "its lines end as on Windows (CR LF), which bash does not understand",
                f"convert it: sed -i 's/\\r$//' {path}",
            )
            continue
        done = subprocess.run(["bash", "-n", path], capture_output=True, text=True, check=False)
        if done.returncode:
            lines = done.stderr.strip().splitlines() or ["?"]
            yield Finding(Level.WRONG, name, f"bash cannot read it: {lines[0]}", "mend that line")


def _try(tool: Tool, runner: Runner, tiny: Tiny, watched: Sequence[Path]) -> Iterator[Finding]:
    where = f"{tiny.entry.id} ({tiny.format})"
    # A tool's own folder may hold half a system, the current one anything.
    before = [_snapshot(folder, folder == watched[0]) for folder in watched]
    finished = runner.run(tiny.entry)
    for folder, old in zip(watched, before, strict=True):
        now = _snapshot(folder, folder == watched[0])
        changed = sorted(str(path) for path, state in now.items() if old.get(path) != state)
        if changed:
            # Its own folder is its own affair as long as it runs one instance at a time.
            theirs = folder != watched[0]
            yield Finding(
                Level.DOUBT if theirs else Level.WRONG,
                where,
                f"it wrote {changed[0]}" + (f" and {len(changed) - 1} more" if changed[1:] else ""),
                "write to the working folder, below TMPDIR, and to the result file only; "
                "several instances may run at once, and nothing else is theirs",
            )
    yield judge(tool, tiny, finished, where)


def judge(tool: Tool, tiny: Tiny, finished: Finished, where: str) -> Finding:
    """Say what a result on a tiny instance is worth."""
    record = finished.record
    problem = _failure(tool, record)
    if problem is not None:
        return Finding(Level.WRONG, where, *problem, _end(finished.log))
    if record.verdict not in (Verdict.SAT, Verdict.UNSAT):
        return Finding(
            Level.DOUBT,
            where,
            f"{record.result}, and the answer is {tiny.answer}",
            "that is no mistake, but it earns nothing; does the tool read this format?",
            _end(finished.log),
        )
    if record.verdict is not tiny.answer:
        return Finding(
            Level.WRONG,
            where,
            f"it says {record.verdict}, and the answer is {tiny.answer}: {tiny.reason}",
            _WRONG_VERDICT,
            _end(finished.log),
        )
    if record.verdict is Verdict.UNSAT:
        return Finding(Level.GOOD, where, f"unsat in {record.run_time:.2f} s")
    return _witness(tiny, record, finished.witness or b"", where)


_WRONG_VERDICT = (
    "an incorrect answer costs 150 points. sat means that the unsafe set can be reached, unsat "
    "that it cannot (VNN-LIB files describe the violation); is that the right way round?"
)


def _witness(tiny: Tiny, record: Record, witness: bytes, where: str) -> Finding:
    try:
        check = check_entry(tiny.entry, record, witness)
    except BadInput as error:
        advice = "leave the instance's files as they are"
        return Finding(Level.WRONG, where, f"its witness cannot be judged: {error}", advice)
    if check.establishes_sat:
        return Finding(
            Level.GOOD, where, f"sat in {record.run_time:.2f} s, with a witness that is right"
        )
    if check.credited:
        return Finding(
            Level.DOUBT,
            where,
            f"its witness is right only up to the tolerance: {check.message}",
            "print every number with 17 digits, and make sure that it lies within its bounds",
        )
    advice = {
        WitnessOutcome.MISSING: "write it after the first line, ",
        WitnessOutcome.MALFORMED: "it must be ",
        WitnessOutcome.OUT_OF_BOX: "print every number with 17 digits; the form is right: ",
    }.get(check.outcome, "replay it with your own tool; the form is right: ")
    return Finding(
        Level.WRONG,
        where,
        f"its sat is right, but its witness is {check.outcome}: {check.message}",
        advice + _FORMS[tiny.format],
    )


_FORMS = {
    Format.JSON: 'one JSON object: {"s": 0.7, "f": 9.9, "v": 0.0, "theta": 0.0}',
    Format.VNNLIB_1: "one s-expression with all inputs, then all outputs: ((X_0 1.0) (Y_0 2.0))",
    Format.VNNLIB_2: "for each tensor a line like `X float32 [1,2]`, then one value a line",
}
_STATUSES = {
    126: "a file that is to be run is not executable: chmod +x it, or call it through bash",
    127: "a command was not found: is the tool installed, and does it rely on PATH?",
    137: "something killed it (SIGKILL); was memory short?",
    139: "it crashed (segmentation fault)",
}


def _failure(tool: Tool, record: Record) -> tuple[str, str] | None:
    """Return what is wrong with a result that is not an answer, and what to do; None if it is."""
    result, limit = record.result, record.limits.wall_s
    shell = tool.description is None
    if result == RUN_TIMEOUT:
        return (
            f"it ran past its limit of {limit:g} s and was ended",
            "stop in time and answer `timeout` or `unknown`; the limit is "
            + ("run_instance.sh's 6th argument" if shell else "{timeout} in run.command"),
        )
    if result == PREPARE_TIMEOUT:
        return f"{PREPARE} took too long and was ended", "it must end before the clock starts"
    if result.startswith(PREPARE_ERROR):
        return (
            f"{PREPARE} ended with status {result.removeprefix(PREPARE_ERROR)}",
            "it must end with 0 also where it has nothing to do",
        )
    if result.startswith(RUN_ERROR):
        status = int(result.removeprefix(RUN_ERROR))
        hint = _STATUSES.get(status, "it must end with 0 whatever it answers")
        if not shell:
            hint += "; statuses that are good stand in run.status"
        return f"it ended with status {status}", hint
    if result == NO_RESULT:
        goal = "to the path that is run_instance.sh's 5th argument" if shell else "to {results}"
        return record.detail or "it wrote no answer", (
            f"write sat, unsat, unknown, timeout or error in the first line, {goal}"
        )
    if result == Verdict.ERROR and record.detail:
        return record.detail, (
            "the first line must be sat, unsat, unknown, timeout or error, and nothing else"
        )
    if result == Verdict.ERROR:
        return "it answers error", "its output may say why"
    return None


def _end(log: bytes) -> str:
    """Return the last lines of a log in one line."""
    lines = [line.strip() for line in log.decode("utf-8", errors="replace").splitlines()]
    return " | ".join([line for line in lines if line][-_LOG_LINES:]) or "(it printed nothing)"


def _snapshot(folder: Path, deep: bool) -> dict[Path, tuple[int, int]]:
    """Return the files in a folder, if ``deep`` below it too, with their times and sizes."""
    found = {}
    for path in folder.rglob("*") if deep else folder.iterdir():
        try:
            state = path.lstat()
        except OSError:
            continue
        if not stat.S_ISDIR(state.st_mode):
            found[path] = (state.st_mtime_ns, state.st_size)
    return found

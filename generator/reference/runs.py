"""Two runs of the harness in a work folder: proofs with their certificates, and their checks.

Limits, resuming, jobs and clusters are the harness's. The tool ``reference`` that ships writes no
certificate; these two tools do the same with one, and let the checker answer ``unsat``.
"""

from __future__ import annotations

import ctypes
import json
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.catalogue import Entry
from harness.records import Record
from harness.store import RunFolder
from racecar.controller import write_whole
from racecar.errors import BadInput

#: Of prctl(2): the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1
_HEAD = """#!/usr/bin/env bash
# {script} v1 ...: written by `generator reference`.
set -eu
[ "$1" = v1 ] || {{ echo "unknown interface version $1" >&2; exit 1; }}
"""
_CERTIFICATE = """spec=${{4##*/}} spec=${{spec%.gz}} spec=${{spec%.json}} spec=${{spec%.vnnlib}}
certificate={certificates}/$spec.h5
"""
_PROVE = """# Starting Python and writing the answer take time that counts: stop a little early.
limit=$(awk -v limit="$6" 'BEGIN { print (limit > 4) ? limit - 2 : limit / 2 }')
case $4 in *.json) asked=(verify "$4") ;; *) asked=(query "$3" "$4") ;; esac
exec "${PYTHON:-python3}" -m verifier "${asked[@]}" --json --result "$5" --timeout "$limit" \\
  --certificate "$certificate"
"""
_CHECK = """status=0
case $4 in *.json) of=() ;; *) of=(--network "$3") ;; esac
"${PYTHON:-python3}" -m verifier check "$certificate" "$4" "${of[@]}" --json || status=$?
case $status in 0) echo unsat > "$5" ;; 1) echo unknown > "$5" ;; *) exit $status ;; esac
"""


@dataclass(frozen=True)
class Outcome:
    """A record of the harness, what the program printed as JSON, and the witness of a sat."""

    record: Record
    printed: dict[str, Any]
    witness: bytes | None

    @property
    def proved(self) -> float | None:
        """The margin that the checker proved; None if it did not accept the certificate."""
        if self.record.verdict == "unsat" and self.printed.get("verdict") == "valid":
            return float(self.printed["margin"])
        return None


@dataclass(frozen=True)
class Work:
    """The work folder and how to run in it; timeouts in seconds, None: the instances' own.

    options: further arguments of ``harness run``, such as --jobs.
    """

    folder: Path
    benchmarks: Path
    timeout: float | None
    check_timeout: float
    options: tuple[str, ...] = ()
    quiet: bool = False

    def certificate(self, instance: str) -> Path:
        """Return where the certificate of an instance lies."""
        return self._certificates / f"{instance}.h5"

    def certified(self, outcome: Outcome) -> bool:
        """Whether a proof ended in unsat, with a certificate."""
        return outcome.record.verdict == "unsat" and (
            self.certificate(outcome.record.instance).is_file()
        )

    @property
    def _certificates(self) -> Path:
        return self.folder / f"certificates{self._suffix}"

    @property
    def _suffix(self) -> str:
        """What tells certificates of other limits apart: a check holds for one certificate."""
        return "" if self.timeout is None else f"-{_limit(self.timeout)}"

    def prove(self, entries: Sequence[Entry]) -> dict[str, Outcome]:
        """Run the reference verifier on what it was not run on yet."""
        return self._run("prove", _PROVE, self.timeout, entries)

    def check(self, entries: Sequence[Entry]) -> dict[str, Outcome]:
        """Let the checker check all rows of certificates; unsat: valid."""
        return self._run("check", _CHECK, self.check_timeout, entries, self._suffix)

    def check_anew(self, entries: Sequence[Entry]) -> dict[str, Outcome]:
        """The same, whatever was checked before."""
        for old in self.folder.glob("verify-*"):
            shutil.rmtree(old)
        return self._run("verify", _CHECK, self.check_timeout, entries, self._suffix)

    def _run(
        self,
        name: str,
        script: str,
        timeout: float | None,
        entries: Sequence[Entry],
        suffix: str = "",
    ) -> dict[str, Outcome]:
        if not entries:
            return {}
        tool = self._tool(name, script)
        out = self.folder / f"{name}-{_limit(timeout)}{suffix}"
        command = [sys.executable, "-m", "harness", "run", f"--tool={tool}", "--resume"]
        command += [f"--out={out}", f"--benchmarks={self.benchmarks}", *self.options]
        command += [] if timeout is None else [f"--timeout={timeout!r}"]
        # It shows a bar where a person watches.
        command += ["--json"] if self.quiet else []
        command += [f"--instance={entry.spec}" for entry in entries]
        done = subprocess.run(
            command,
            stdout=subprocess.DEVNULL,
            check=False,
            preexec_fn=_end_with_parent,
        )
        if done.returncode == 130:
            raise KeyboardInterrupt
        # 1: the harness's score finds the present reference.csv refuted; it is made anew here.
        if done.returncode not in (0, 1):
            raise BadInput(f"{out}: harness run ended with status {done.returncode}, as said above")
        wanted = {entry.id for entry in entries}
        with RunFolder.open(out) as run:
            return {
                record.instance: Outcome(
                    record,
                    _printed(run.log(record)),
                    run.witness(record) if record.verdict == "sat" else None,
                )
                for record in run.records()
                if record.instance in wanted
            }

    def _tool(self, name: str, script: str) -> Path:
        folder = self.folder / f"tools{self._suffix}" / name
        self._certificates.mkdir(parents=True, exist_ok=True)
        place = _CERTIFICATE.format(certificates=shlex.quote(str(self._certificates.resolve())))
        prepare = "prepare_instance.sh"
        write_whole(folder / prepare, _HEAD.format(script=prepare).encode())
        run = "run_instance.sh"
        write_whole(folder / run, (_HEAD.format(script=run) + place + script).encode())
        return folder


def _limit(timeout: float | None) -> str:
    return "own" if timeout is None else f"{timeout:g}s"


def _end_with_parent() -> None:
    """Let the harness be told to end when this program does, however that comes (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _printed(log: bytes) -> dict[str, Any]:
    """Return the last JSON object that a log holds, {} if there is none."""
    for line in reversed(log.decode(errors="replace").splitlines()):
        if line.startswith("{"):
            try:
                return dict(json.loads(line))
            except ValueError:
                continue
    return {}

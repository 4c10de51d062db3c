"""Certificates for pictures: the reference verifier is run as a process, like any tool."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from harness.records import Verdict
from leaderboard.questions import Question, read_questions
from leaderboard.runs import JudgedRun
from leaderboard.tube import read_tube
from racecar.errors import BadInput
from racecar.instance import PlantData, make_plant

#: Beyond the time limit that the verifier itself keeps (s).
_PATIENCE_S = 60.0
KEPT, MADE, NONE = "kept", "made", "not proved"


def make_certificates(
    runs: Sequence[JudgedRun], root: Path, folder: Path, timeout: float
) -> Iterator[tuple[str, str]]:
    """Make the certificates that are missing; yield instances with what came of each.

    Only instances in JSON of which some tool says unsat. timeout: seconds for each.
    """
    records = [record for run in runs for record in run.records()]
    unsat = {record.instance for record in records if record.verdict is Verdict.UNSAT}
    folder.mkdir(parents=True, exist_ok=True)
    for question in read_questions(records, root):
        if question.data is not None and question.id in unsat:
            yield question.id, _one(question, folder / f"{question.id}.h5", timeout)


def _one(question: Question, path: Path, timeout: float) -> str:
    if path.is_file() and _fits(question, path):
        return KEPT
    command = [sys.executable, "-m", "verifier", "verify", str(question.spec),
               "--timeout", repr(timeout), "--certificate", str(path), "--json"]  # fmt: skip
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout + _PATIENCE_S, check=False
        )
    except subprocess.TimeoutExpired:
        return NONE
    if done.returncode:
        reason = (done.stderr.strip() or f"status {done.returncode}").splitlines()[-1]
        raise BadInput(f"{question.id}: the reference verifier failed ({reason})")
    answer = json.loads(done.stdout)
    return MADE if answer["verdict"] == Verdict.UNSAT and path.is_file() else NONE


def _fits(question: Question, path: Path) -> bool:
    """Say whether a file is the certificate of this very instance."""
    assert question.data is not None
    plant = make_plant(PlantData.model_validate(question.data["plant"]))
    try:
        read_tube(path, question.data, question.onnx_sha256, plant.track)
    except BadInput:
        return False
    return True

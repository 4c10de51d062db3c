"""A submission in the place of a run, for those who score many."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from harness.records import Record, WitnessCheck
from harness.submission.verify import verify_submission
from racecar.errors import BadInput


@dataclass(frozen=True)
class Submitted:
    """The results of a valid submission, every witness judged anew."""

    path: Path
    checked: tuple[tuple[Record, WitnessCheck | None], ...]


def open_submission(path: Path, root: Path | None) -> Submitted:
    """Return the results of a submission; BadInput unless it is valid.

    root: the benchmarks folder, which it is verified against.
    """
    if root is None:
        raise BadInput(f"{path}: to verify it, give the instances with --benchmarks")
    verified = verify_submission(path, root)
    if verified.problems:
        raise BadInput(
            f"{path}: not a valid submission ({verified.problems[0]}); "
            "see harness verify-submission"
        )
    return Submitted(path, verified.checked)

"""Checking a certificate file: all rows or a sample, on one core or several."""

from __future__ import annotations

import multiprocessing
import random
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from checker.files import Rejected, read_certificate, read_instance
from checker.rows import Checker

#: Checks some rows and returns how many there were, and the first fault ("" if none).
Work = Callable[[list[int]], tuple[int, str]]
#: Rows that a process takes at a time.
_CHUNK = 256


@dataclass(frozen=True)
class Report:
    """What was found: valid is only said of a certificate all of whose rows were checked.

    verdict: "valid", "sampled" (no fault found in the sample) or "rejected", with the reason;
    margin: claimed and, if valid, proved (m); checked: rows looked at; time_s: wall time.
    """

    verdict: str
    margin: float
    rows: int
    checked: int
    time_s: float
    reason: str = ""


def check(
    certificate: Path, instance: Path, sample: int | None = None, seed: int = 0, jobs: int = 1,
    report: Callable[[float], None] = lambda share: None,
) -> Report:  # fmt: skip
    """Check a certificate; raises Unreadable. sample: so many rows, drawn by ``seed``."""
    began = time.perf_counter()
    cert, question = read_certificate(certificate), read_instance(instance)
    total, reason, done = len(cert.rows), "", 0
    indices = list(range(total))
    if sample is not None:
        indices = sorted(random.Random(seed).sample(indices, min(sample, total)))
    try:
        checker = Checker(cert, question)
        checker.check_all()
        chunks = [indices[k : k + _CHUNK] for k in range(0, len(indices), _CHUNK)]
        work: Work = partial(_check_rows, checker)
        if jobs > 1:
            work = partial(_check_again, certificate, instance)
        for count, fault in _mapped(work, chunks, jobs):
            if fault:
                raise Rejected(fault)
            done += count
            report(done / len(indices))
    except Rejected as error:
        reason = str(error)
    verdict = "rejected" if reason else "valid" if done == total else "sampled"
    return Report(verdict, cert.margin, total, done, time.perf_counter() - began, reason)


def _mapped(work: Work, chunks: list[list[int]], jobs: int) -> Iterator[tuple[int, str]]:
    if jobs == 1:
        yield from map(work, chunks)
        return
    with multiprocessing.get_context("spawn").Pool(min(jobs, len(chunks))) as pool:
        yield from pool.imap_unordered(work, chunks)


def _check_rows(checker: Checker, rows: list[int]) -> tuple[int, str]:
    try:
        checker.check_rows(rows)
    except Rejected as error:
        return 0, str(error)
    return len(rows), ""


@cache
def _read_checker(certificate: Path, instance: Path) -> Checker:
    return Checker(read_certificate(certificate), read_instance(instance))


def _check_again(certificate: Path, instance: Path, rows: list[int]) -> tuple[int, str]:
    """Check rows in another process, which reads the files once."""
    return _check_rows(_read_checker(certificate, instance), rows)

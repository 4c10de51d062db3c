"""Instances with their certificates, and what tests do with them."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings

from checker.files import Rejected, read_certificate, read_instance
from checker.rows import Checker
from racecar.controller import RuntimeSteer
from racecar.instance import controller_path
from verifier.certificate import GATHERED, Certificate, write_certificate
from verifier.certificate import read_certificate as read_written
from verifier.certify import certify
from verifier.problem import load_problem
from verifier.verify import verify_recorded

ROOT = Path(__file__).parents[2]
ONNX = ROOT / "onnx"
QUICK = ROOT / "benchmarks" / "quick" / "json"
_ROWS = {
    "step", "frame", "case", "parent", "kind", "centre", "spread", "radius", "piece", "guard",
    "elsewhere", "into",
}  # fmt: skip

#: Few examples: each is a certificate checked.
SOME = settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@dataclass(frozen=True)
class Proof:
    """An instance file, the certificate of it, and the folder for files made of it."""

    instance: Path
    certificate: Certificate
    folder: Path

    def checker(self, cert: Certificate) -> Checker:
        """Return a checker of another certificate of the instance, read from a file."""
        path = self.folder / "mutated.h5"
        write_certificate(cert, path)
        return Checker(read_certificate(path), read_instance(self.instance))

    def fault(self, cert: Certificate, rows: list[int] | None = None) -> str:
        """Return why a certificate is rejected, looking at the steps of some rows; "" if not."""
        try:
            checker = self.checker(cert)
            checker.check_all()
            checker.check_rows(list(range(len(cert)) if rows is None else rows))
        except Rejected as error:
            return str(error)
        return ""


def write_instance(path: Path, base: str, **changes: Any) -> Path:
    """Write an instance like a published one, with other fields; return its path."""
    data = json.loads((QUICK / f"{base}.json").read_text())
    for name, value in changes.items():
        data[name] = {**data.get(name, {}), **value} if isinstance(value, dict) else value
    data["controller"]["file"] = str(ONNX / f"{data['controller']['name']}.onnx")
    data["id"] = data["category"] = "tests"
    path.write_text(json.dumps(data))
    return path


def proved(instance: Path, folder: Path, name: str) -> Proof:
    """Return the proof of an instance by the verifier."""
    data, problem = load_problem(instance)
    answer, record = verify_recorded(
        problem, RuntimeSteer(controller_path(data, instance)), 100.0, lambda share: None, 1, True
    )
    assert record is not None, answer
    assert answer.margin_lower is not None, answer
    target = folder / f"{name}.h5"
    certify(record, answer.margin_lower, problem, data, instance, target)
    return Proof(instance, read_written(target), folder)


def changed(cert: Certificate, index: int | np.ndarray, **values: Any) -> Certificate:
    """Return a certificate in which fields of one row or more (or a guard) have other values."""
    arrays = {}
    for name, value in values.items():
        arrays[name] = np.array(getattr(cert, name))
        arrays[name][index] = value
    return replace(cert, **arrays)


def taken(cert: Certificate, rows: np.ndarray) -> Certificate:
    """Return a certificate of some rows (indices); of rows that are dropped, the number is -1."""
    number = np.full(len(cert) + 1, -1)
    number[rows] = np.arange(len(rows))
    arrays = {name: getattr(cert, name)[rows] for name in _ROWS}
    arrays["parent"], arrays["into"] = number[arrays["parent"]], number[arrays["into"]]
    return replace(cert, **arrays)


def joined(first: Certificate, second: Certificate) -> Certificate:
    """Return the rows of one certificate and then of another of the same guards and cases."""
    arrays = {n: np.concatenate([getattr(first, n), getattr(second, n)]) for n in _ROWS}
    for name in ("parent", "into"):
        later = getattr(second, name)
        moved = np.where(later < 0, -1, later + len(first))
        arrays[name] = np.concatenate([getattr(first, name), moved])
    return replace(first, **arrays)


def added(cert: Certificate, like: int, **values: Any) -> Certificate:
    """Return a certificate with one row more at its end, equal to another but for some fields."""
    arrays = {}
    for name in _ROWS:
        column = getattr(cert, name)
        arrays[name] = np.concatenate([column, [values.get(name, column[like])]])
    return replace(cert, **arrays)


def gathered(cert: Certificate, sources: list[int]) -> Certificate:
    """Return a certificate with one row more, the last, that contains some rows.

    They go into it. It lies along their principal directions, x the longest.
    """
    arms = np.concatenate([cert.centre[:, :, 1:], cert.spread.reshape(len(cert), 4, -1)], axis=2)
    arms, middles, rest = arms[sources], cert.centre[sources, :, 0], cert.radius[sources]
    cloud = np.concatenate([(middles - middles.mean(axis=0)).T, *arms], axis=1)
    axes = np.linalg.svd(cloud)[0]
    reach = np.abs(axes.T @ arms).sum(axis=2) + rest @ np.abs(axes)
    low, high = (middles @ axes - reach).min(axis=0), (middles @ axes + reach).max(axis=0)
    directions = axes * ((high - low) / 2 * (1 + 1e-9) + 1e-12)
    centre, spread = np.zeros((4, 6)), np.zeros_like(cert.spread[0])
    centre[:, 0], centre[:, 1] = axes @ (low + high) / 2, directions[:, 0]
    spread[:, :3, 0] = directions[:, 1:]
    whole = {
        "parent": -1, "kind": GATHERED, "centre": centre, "spread": spread, "guard": -1,
        "radius": np.full(4, 1e-13), "piece": np.tile([-1.0, 1.0], (len(cert.piece[0]), 1)),
        "elsewhere": False, "into": -1,
    }  # fmt: skip
    return changed(added(cert, sources[0], **whole), np.array(sources), into=len(cert))


def descendants(cert: Certificate, row: int) -> np.ndarray:
    """Return which rows ``[n]`` follow from a row, not itself."""
    below = np.zeros(len(cert), dtype=bool)
    for i in range(row + 1, len(cert)):
        below[i] = cert.parent[i] == row or (cert.parent[i] >= 0 and below[cert.parent[i]])
    return below

"""What an instance asks, read from its files where they are the ones that were run."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.catalogue import find_file, sha256
from harness.records import Record
from racecar.controller import load_controller
from racecar.errors import BadInput

_NAME = re.compile(
    r"(?P<controller>[A-Za-z0-9]+_L(?P<rays>\d+)_(?:conv|(?P<layers>\d+(?:x\d+)*)(?:relu)?)_C\d+)\."
)


@dataclass(frozen=True)
class Question:
    """One instance.

    controller, rays, layers ("64x64"), width (of the start set in s, metres), steps, safety (the
    property) and disturbance: None where they do not apply or are not known. data: the JSON form,
    where there is one and it is the one that was run; spec, onnx: its files, where they are.
    """

    id: str
    category: str
    spec_name: str
    onnx_name: str
    spec_sha256: str
    onnx_sha256: str
    timeout: float
    controller: str | None = None
    rays: int | None = None
    layers: str | None = None
    width: float | None = None
    steps: int | None = None
    safety: str | None = None
    disturbance: str | None = None
    data: Mapping[str, Any] | None = None
    spec: Path | None = None
    onnx: Path | None = None

    @property
    def neurons(self) -> int | None:
        """Hidden neurons in all."""
        return sum(map(int, self.layers.split("x"))) if self.layers else None


def read_questions(records: Iterable[Record], root: Path | None) -> list[Question]:
    """Return the instances that records are of, each once, by category and ID."""
    first: dict[str, Record] = {}
    limits: dict[str, float] = {}
    for record in records:
        first.setdefault(record.instance, record)
        limits[record.instance] = max(limits.get(record.instance, 0.0), record.limits.wall_s)
    ordered = sorted(first.values(), key=lambda record: (record.category, record.instance))
    files = _Files(root)
    return [_read(record, limits[record.instance], files) for record in ordered]


class _Files:
    """The benchmarks' files; a network is read once, however many instances have it."""

    def __init__(self, root: Path | None) -> None:
        self._root = root
        self._hashes: dict[Path, str] = {}
        self._layers: dict[Path, str | None] = {}

    def same(self, name: str, expected: str) -> Path | None:
        """Return where a file lies, if it is there and the one that was run."""
        if self._root is None:
            return None
        path = find_file(self._root / name)
        if path is None:
            return None
        if path not in self._hashes:
            self._hashes[path] = sha256(path)
        return path if self._hashes[path] == expected else None

    def layers(self, onnx: Path) -> str | None:
        """Return the sizes of a controller's hidden layers; None if it is no chain of layers."""
        if onnx not in self._layers:
            self._layers[onnx] = _layers(onnx)
        return self._layers[onnx]


def _read(record: Record, timeout: float, files: _Files) -> Question:
    known: dict[str, Any] = {}
    match = _NAME.match(record.instance)
    if match:
        known = {
            "controller": match["controller"], "rays": int(match["rays"]), "layers": match["layers"]
        }  # fmt: skip
    spec = files.same(record.spec, record.spec_sha256)
    onnx = files.same(record.onnx, record.onnx_sha256)
    if onnx is not None:
        known["layers"] = files.layers(onnx) or known.get("layers")
    if spec is not None and onnx is not None and spec.suffix == ".json":
        known |= _json_facts(spec)
    return Question(
        id=record.instance,
        category=record.category,
        spec_name=record.spec,
        onnx_name=record.onnx,
        spec_sha256=record.spec_sha256,
        onnx_sha256=record.onnx_sha256,
        timeout=timeout,
        spec=spec,
        onnx=onnx,
        **known,
    )


def _layers(onnx: Path) -> str | None:
    try:
        hidden = load_controller(onnx).layers[:-1]
    except BadInput:
        return None
    # A last layer of one neuron only scales the answer.
    return "x".join(str(len(layer.biases)) for layer in hidden if len(layer.biases) > 1) or None


def _json_facts(spec: Path) -> dict[str, Any]:
    try:
        data = json.loads(spec.read_bytes())
        low, high = data["initial_set"]["s"]
        disturbance = data.get("disturbance")
        return {
            "controller": str(data["controller"]["name"]),
            "rays": int(data["plant"]["lidar"]["rays"]),
            "width": round(high - low, 9),
            "steps": int(data["steps"]),
            "safety": str(data["property"]["name"]),
            "disturbance": disturbance and _disturbance(disturbance),
            "data": data,
        }
    except (ValueError, KeyError, TypeError, OSError):
        return {}  # run, but not an instance of ours


def _disturbance(data: Mapping[str, Any]) -> str:
    parts = []
    if data["noise"]:
        parts.append(f"noise of up to {1000 * data['noise']:g} mm")
    if data["missing"]:
        when = "in the turn" if data["turn_only"] else "at any time"
        how = "the same in the whole run" if data["choice"] == "run" else "others at each step"
        rays = "ray" if data["missing"] == 1 else "rays"
        parts.append(f"up to {data['missing']} missing {rays} {when}, {how}")
    if mirrors := data.get("mirrors"):
        count, degrees = len(mirrors["segments"]), math.degrees(mirrors["incidence"])
        walls = "a stretch of wall" if count == 1 else f"one of {count} stretches of wall"
        parts.append(f"{walls} may mirror rays at more than {degrees:.4g}° from its normal")
    return "; ".join(parts)

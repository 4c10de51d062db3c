"""The certificate of a question: boxes and how they were divided (docs/certificates.md)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from racecar.controller import write_whole
from verifier.query.divide import Tree

Array = NDArray[np.float64]
FORMAT, VERSION = "closedlap-query-certificate", "1.0"


@dataclass(frozen=True)
class Hashes:
    """sha256 of the unpacked files."""

    onnx: str
    spec: str


def write_certificate(
    path: Path, hashes: Hashes, boxes: tuple[Array, Array], trees: Sequence[Tree]
) -> None:
    """Write the file, whole or not at all.

    boxes: lower and upper bounds, ``[boxes, inputs]`` each; trees: of each box.
    """
    content = io.BytesIO()
    with h5py.File(content, "w", track_order=True) as file:
        file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
        file.attrs["onnx_sha256"], file.attrs["spec_sha256"] = hashes.onnx, hashes.spec
        file.attrs["creator"] = f"closedlap {version('closedlap')}"
        for name, values in (
            ("boxes/lower", boxes[0]),
            ("boxes/upper", boxes[1]),
            ("nodes/dim", np.array([d for tree in trees for d in tree.dim], dtype=np.int32)),
            ("nodes/at", np.array([x for tree in trees for x in tree.at], dtype=np.float64)),
        ):
            packing = {"compression": "gzip", "shuffle": True} if values.size else {}
            file.create_dataset(name, data=values, track_times=False, **packing)
    write_whole(path, content.getvalue())

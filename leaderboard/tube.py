"""The reach tube in a reference verifier's certificate, as polygons to draw.

docs/certificates.md says what the file holds. A row is a set of states; each is enclosed here in a
rectangle of the (s, f) plane that lies along the row. Where a step has many rows, neighbours go
into one convex hull, so that a picture stays small; it still encloses all of them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from racecar.errors import BadInput
from racecar.polygon import Array
from racecar.track import Track

FORMAT, VERSION = "closedlap-certificate", "1.0"
#: Kinds of rows that together cover a step: roots and images. (Parts lie within their parents,
#: gathered rows around rows of the same step.)
_COVERING = (0, 2)
#: At most so many polygons a step.
MOST = 12
#: Added all round, m: beyond the rounding of numbers that are drawn to 0.1 mm.
_SLACK = 1e-4


@dataclass(frozen=True, eq=False)
class Tube:
    """Polygons ``[k, 2]`` (global x, y in metres) for each step, and the margin proved (m)."""

    steps: list[list[Array]]
    margin: float


def read_tube(path: Path, data: Mapping[str, Any], onnx_sha256: str, track: Track) -> Tube:
    """Read the tube of an instance (its JSON form) from a certificate.

    Raises BadInput if the file is no certificate, or one of another instance or controller.
    """
    canonical = json.dumps(data, sort_keys=True, separators=(",", ":"))
    wanted = hashlib.sha256(canonical.encode()).hexdigest()
    try:
        with h5py.File(path, "r") as file:
            if (file.attrs["format"], file.attrs["version"]) != (FORMAT, VERSION):
                raise BadInput(f"{path}: not a certificate of format {FORMAT} {VERSION}")
            if file.attrs["instance_sha256"] != wanted:
                raise BadInput(f"{path}: it is the certificate of another instance")
            if file.attrs["weights_sha256"] != onnx_sha256:
                raise BadInput(f"{path}: it is the certificate of another controller")
            names = ("step", "frame", "kind", "centre", "spread", "radius", "elsewhere")
            rows = {name: file[f"rows/{name}"][()] for name in names}
            margin = float(file.attrs["margin"])
    except (OSError, KeyError, RuntimeError, ValueError, TypeError):
        raise BadInput(f"{path}: not a complete certificate (HDF5) file") from None
    keep = np.isin(rows["kind"], _COVERING) & ~rows["elsewhere"].astype(bool)
    rows = {name: values[keep] for name, values in rows.items()}
    if not len(rows["step"]):
        raise BadInput(f"{path}: it holds no row")
    corners = rectangles(rows["centre"][:, :2], rows["spread"][:, :2], rows["radius"][:, :2])
    frames = np.broadcast_to(rows["frame"][:, None], corners.shape[:2])
    x, y, _ = track.to_global(frames, corners[..., 0], corners[..., 1], 0.0)
    corners = np.stack([x, y], axis=-1)
    steps: list[list[Array]] = []
    for step in range(int(rows["step"].max()) + 1):
        steps.append(_few(corners[rows["step"] == step]))
    return Tube(steps, margin)


def rectangles(centre: Array, spread: Array, radius: Array) -> Array:
    """Return rectangles ``[n, 4, 2]`` that enclose sets of the (s, f) plane.

    centre: ``[n, 2, 6]``; spread: ``[n, 2, m, 2]``; radius: ``[n, 2]``, as in a certificate. A
    point is sum centre[k] x^k + sum (spread[j, 0] + spread[j, 1] x) e_j + rest, x and e_j in
    [-1, 1], |rest| <= radius: along a unit vector d, x^k lies in [-1, 1], or in [0, 1] if k is
    even, and what is uncertain besides adds its length.
    """
    along = centre[..., 1].copy()
    # A set with no length along x lies along its longest symbol.
    longest = np.argmax(np.linalg.norm(spread[..., 0], axis=1), axis=1)
    other = spread[np.arange(len(spread)), :, longest, 0]
    longer = np.linalg.norm(other, axis=1) > np.linalg.norm(along, axis=1)
    along[longer] = other[longer]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    unit = np.where(length > 0, along / np.maximum(length, 1e-300), [1.0, 0.0])
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    ends = [_extent(centre, spread, radius, d) for d in (unit, normal)]
    (a0, a1), (b0, b1) = ends
    corners = [
        a[:, None] * unit + b[:, None] * normal for a, b in ((a0, b0), (a1, b0), (a1, b1), (a0, b1))
    ]
    return np.stack(corners, axis=1)


def _extent(centre: Array, spread: Array, radius: Array, d: Array) -> tuple[Array, Array]:
    """Return the least and the largest value along unit vectors ``d`` (``[n, 2]``)."""
    along = np.einsum("nik,ni->nk", centre, d)
    odd = np.abs(along[:, 1::2]).sum(axis=1)
    even = along[:, 2::2]
    rest = np.abs(np.einsum("nijk,ni->njk", spread, d)).sum(axis=(1, 2))
    rest += (radius * np.abs(d)).sum(axis=1) + odd + _SLACK
    low = along[:, 0] + np.minimum(even, 0).sum(axis=1) - rest
    return low, along[:, 0] + np.maximum(even, 0).sum(axis=1) + rest


def _few(corners: Array) -> list[Array]:
    """Return at most MOST polygons that cover polygons ``[n, 4, 2]``: hulls of neighbours."""
    if len(corners) <= MOST:
        return list(corners)
    middle = corners.mean(axis=1)
    spread = middle - middle.mean(axis=0)
    axis = np.linalg.svd(spread, full_matrices=False)[2][0]
    order = np.argsort(spread @ axis, kind="stable")
    return [hull(corners[group].reshape(-1, 2)) for group in np.array_split(order, MOST)]


def hull(points: Array) -> Array:
    """Return the convex hull's corners ``[k, 2]``, counter-clockwise (Andrew 1979)."""
    ordered = sorted({(float(x), float(y)) for x, y in points})
    if len(ordered) < 3:
        return np.array(ordered)
    lower, upper = _chain(ordered), _chain(ordered[::-1])
    return np.array(lower[:-1] + upper[:-1])


def _chain(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    chain: list[tuple[float, float]] = []
    for p in points:
        while len(chain) > 1 and _turn(chain[-2], chain[-1], p) <= 0:
            chain.pop()
        chain.append(p)
    return chain


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def certificate_files(folder: Path | None) -> Mapping[str, Path]:
    """Return the certificates below a folder by the instance that their names say."""
    if folder is None:
        return {}
    if not folder.is_dir():
        raise BadInput(f"{folder}: there is no folder of certificates")
    files = sorted(folder.rglob("*.h5"))
    return {path.stem.removesuffix(".certificate"): path for path in files}


def sha256_of(path: Path | None) -> str:
    """Return the hash of a file, or of nothing."""
    if path is None:
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""Certificates: what a proof consists of, as arrays, and the HDF5 file that holds them.

docs/certificates.md says what every array means and what ``verifier check`` proves of it.
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from racecar.controller import write_whole
from racecar.errors import BadInput

FORMAT, VERSION = "closedlap-certificate", "1.0"

#: Kinds of rows.
ROOT, PART, IMAGE, ADVANCE, GATHERED = range(5)
#: Kinds of guards.
CROSS, ADVANCE_GUARD, TURN = range(3)

_TERMS = 6
_STATES = 4
#: Name, type, unit and meaning of each dataset; the shape in terms of rows n, symbols m,
#: guards g, cases c and rays r.
_LAYOUT: dict[str, tuple[str, str, tuple[str | int, ...], str]] = {
    "rows/step": ("<u4", "1", ("n",), "control periods driven before"),
    "rows/frame": ("<u2", "1", ("n",), "local frame in which the state is given"),
    "rows/case": ("<u2", "1", ("n",), "index into cases"),
    "rows/parent": ("<i4", "1", ("n",), "row that this one belongs to, -1 for a root"),
    "rows/kind": ("|u1", "1", ("n",), "0 root, 1 part, 2 image, 3 advance, 4 gathered"),
    "rows/centre": (
        "<f8", "m, m, m/s, rad", ("n", _STATES, _TERMS),
        "coefficients of x^0 to x^5 of s, f, v, theta",
    ),
    "rows/spread": (
        "<f8", "m, m, m/s, rad", ("n", _STATES, "m", 2),
        "coefficients of e_j and of x e_j of s, f, v, theta",
    ),
    "rows/radius": (
        "<f8", "m, m, m/s, rad", ("n", _STATES), "bounds of the rest of s, f, v, theta"
    ),
    "rows/piece": (
        "<f8", "1", ("n", "1+m", 2),
        "lower and upper ends of x, e_0, ... of the parent that the row covers; of a root, "
        "first: the part of the start interval",
    ),
    "rows/guard": ("<i4", "1", ("n",), "index into guards of the sign that is assumed, or -1"),
    "rows/elsewhere": ("|b1", "1", ("n",), "whether later roots cover what became of this row"),
    "rows/into": ("<i4", "1", ("n",), "gathered row that contains this one, or -1"),
    "guards/kind": ("|u1", "1", ("g",), "0 cross, 1 advance, 2 turn"),
    "guards/ray": ("<i4", "1", ("g",), "ray, or -1"),
    "guards/obstacle": ("<i4", "1", ("g",), "obstacle of the frame, or -1"),
    "guards/front": ("<i4", "1", ("g",), "face j of the obstacle, or -1"),
    "guards/back": ("<i4", "1", ("g",), "face k of the obstacle, or -1"),
    "guards/positive": ("|b1", "1", ("g",), "whether the value is assumed >= 0, else <= 0"),
    "cases/missing": ("|b1", "1", ("c", "r"), "which rays are, or may be, missing"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Certificate:
    """A forest of rows: each is a set of states, with how it follows from its parent.

    Of the rows (n), in the order s, f, v, theta (m, m, m/s, rad): step, frame, case, parent,
    kind, guard, elsewhere, into: ``[n]``; centre: ``[n, 4, 6]``; spread: ``[n, 4, m, 2]``; radius:
    ``[n, 4]``; piece: ``[n, 1 + m, 2]``. Of the guards (g): guard_kind, ray, obstacle, front,
    back, positive: ``[g]``. missing: ``[cases, rays]``. margin: the claimed lower bound (m);
    lead: the component that x runs along at the start; the hashes as hexadecimal text.
    """

    instance_sha256: str
    weights_sha256: str
    margin: float
    lead: int
    step: NDArray[np.integer]
    frame: NDArray[np.integer]
    case: NDArray[np.integer]
    parent: NDArray[np.integer]
    kind: NDArray[np.integer]
    centre: NDArray[np.float64]
    spread: NDArray[np.float64]
    radius: NDArray[np.float64]
    piece: NDArray[np.float64]
    guard: NDArray[np.integer]
    elsewhere: NDArray[np.bool_]
    into: NDArray[np.integer]
    guard_kind: NDArray[np.integer]
    ray: NDArray[np.integer]
    obstacle: NDArray[np.integer]
    front: NDArray[np.integer]
    back: NDArray[np.integer]
    positive: NDArray[np.bool_]
    missing: NDArray[np.bool_]
    creator: str = "ClosedLap reference verifier"

    @property
    def symbols(self) -> int:
        """The number m of error symbols."""
        return int(self.spread.shape[2])

    def __len__(self) -> int:
        """The number of rows."""
        return len(self.step)


def instance_sha256(content: bytes) -> str:
    """Return the hash of an instance's content, independent of how its JSON is laid out."""
    canonical = json.dumps(json.loads(content), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def _field(path: str) -> str:
    group, name = path.split("/")
    return "guard_kind" if group == "guards" and name == "kind" else name


def write_certificate(cert: Certificate, path: Path) -> None:
    """Write a certificate, whole or not at all; the same certificate gives the same bytes.

    Raises ValueError if its arrays do not fit together or do not fit their types.
    """
    arrays = {name: getattr(cert, _field(name)) for name in _LAYOUT}
    problem = _misfit(arrays)
    if problem:
        raise ValueError(f"certificate: {problem}")
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver="v108") as file:
        file.attrs.update(
            {
                "format": FORMAT,
                "version": VERSION,
                "instance_sha256": cert.instance_sha256,
                "weights_sha256": cert.weights_sha256,
                "margin": float(cert.margin),
                "lead": int(cert.lead),
                "symbols": cert.symbols,
                "creator": cert.creator,
            }
        )
        for name, (kind, units, _, description) in _LAYOUT.items():
            values = np.asarray(arrays[name])
            stored = values.astype(kind)
            if not np.array_equal(stored, values):
                raise ValueError(f"certificate: {name} does not fit its type {kind}")
            packing = {"compression": "gzip", "shuffle": True} if stored.size else {}
            dataset = file.create_dataset(name, data=stored, track_times=False, **packing)
            dataset.attrs["units"] = units
            dataset.attrs["description"] = description
    write_whole(Path(path), buffer.getvalue())


def read_certificate(path: Path) -> Certificate:
    """Read a certificate; BadInput if the file is missing, damaged or of another kind."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            header = {key: file.attrs[key] for key in file.attrs}
            if header.get("format") != FORMAT or header.get("version") != VERSION:
                raise BadInput(f"{path}: not a certificate of format {FORMAT} {VERSION}")
            arrays = {name: file[name][()] for name in _LAYOUT}
        wrong = [n for n, (kind, *_) in _LAYOUT.items() if arrays[n].dtype != np.dtype(kind)]
        problem = f"{wrong[0]} is not of type {_LAYOUT[wrong[0]][0]}" if wrong else _misfit(arrays)
        if problem:
            raise BadInput(f"{path}: {problem}")
        if int(header["symbols"]) != arrays["rows/spread"].shape[2]:
            raise BadInput(f"{path}: symbols is {header['symbols']}, which rows/spread is not")
        return Certificate(
            instance_sha256=str(header["instance_sha256"]),
            weights_sha256=str(header["weights_sha256"]),
            margin=float(header["margin"]),
            lead=int(header["lead"]),
            creator=str(header["creator"]),
            **{_field(name): values for name, values in arrays.items()},
        )
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError):
        # What h5py makes of damaged files.
        raise BadInput(f"{path}: not a complete certificate (HDF5) file") from None


def _misfit(arrays: dict[str, NDArray]) -> str:
    """Say which array does not have the shape that the others ask for; "" if all fit."""
    if np.ndim(arrays["rows/spread"]) != 4 or np.ndim(arrays["cases/missing"]) != 2:
        return "rows/spread or cases/missing has the wrong number of axes"
    m = arrays["rows/spread"].shape[2]
    cases, rays = arrays["cases/missing"].shape
    guards = len(arrays["guards/kind"])
    sizes = {"n": len(arrays["rows/spread"]), "m": m, "1+m": 1 + m, "g": guards, "c": cases,
             "r": rays}  # fmt: skip
    for name, (_, _, shape, _) in _LAYOUT.items():
        wanted = tuple(sizes[x] if isinstance(x, str) else x for x in shape)
        if np.shape(arrays[name]) != wanted:
            return f"{name} has shape {list(np.shape(arrays[name]))}, not {list(wanted)}"
    return ""

"""HDF5 files as plain trees of datasets: the same tree gives the same bytes.

No timestamps, a fixed file format version, no compression (its bytes depend on the library).
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field

import h5py
import numpy as np
from numpy.typing import NDArray

#: The file format: readable by every HDF5 library since 1.8.
_VERSIONS = ("v108", "v108")


@dataclass(frozen=True, eq=False)
class Dataset:
    """An array with its unit ("1" for counts and text) and what it means."""

    values: NDArray
    units: str
    description: str


@dataclass(frozen=True)
class Group:
    """Datasets and groups by name; attributes: further text about the group."""

    description: str
    members: Mapping[str, Dataset | Group]
    attributes: Mapping[str, str] = field(default_factory=dict)


def to_bytes(root: Group) -> bytes:
    """Return the HDF5 file of a tree."""
    with h5py.File("tree", "w", driver="core", backing_store=False, libver=_VERSIONS) as file:
        _write(file, root)
        file.flush()
        return bytes(file.id.get_file_image())


def text(values: object) -> NDArray:
    """Return an array of ASCII strings of one length, as HDF5 stores it best."""
    return np.asarray(values, dtype=np.bytes_)


def floats(values: object) -> NDArray[np.float64]:
    """Return an array of little-endian doubles."""
    return np.asarray(values, dtype="<f8")


def _write(target: h5py.Group, group: Group) -> None:
    target.attrs["description"] = group.description
    target.attrs["units"] = "1"
    for name, value in group.attributes.items():
        target.attrs[name] = value
    for name, member in group.members.items():
        if isinstance(member, Group):
            _write(target.create_group(name), member)
        else:
            dataset = target.create_dataset(name, data=member.values, track_times=False)
            dataset.attrs["description"] = member.description
            dataset.attrs["units"] = member.units


def differences(first: bytes, second: bytes, tolerance: float) -> list[str]:
    """Return the paths of what differs between two HDF5 files.

    tolerance: by which real numbers may differ, absolutely; all else must be equal. A file
    that is not HDF5 differs at "/".
    """
    try:
        with h5py.File(io.BytesIO(first), "r") as a, h5py.File(io.BytesIO(second), "r") as b:
            return list(dict.fromkeys(_compare(a, b, tolerance)))
    except (OSError, KeyError, RuntimeError, ValueError):  # what h5py makes of damaged files
        return ["/"]


def _compare(a: h5py.Group, b: h5py.Group, tolerance: float) -> list[str]:
    found = [] if dict(a.attrs) == dict(b.attrs) else [a.name]
    found += [f"{a.name.rstrip('/')}/{name}" for name in sorted(set(a) ^ set(b))]
    for name in sorted(set(a) & set(b)):
        x, y = a[name], b[name]
        if isinstance(x, h5py.Group) and isinstance(y, h5py.Group):
            found += _compare(x, y, tolerance)
        elif not (
            isinstance(x, h5py.Dataset)
            and isinstance(y, h5py.Dataset)
            and dict(x.attrs) == dict(y.attrs)
            and _equal(x, y, tolerance)
        ):
            found.append(x.name)
    return found


def _equal(x: h5py.Dataset, y: h5py.Dataset, tolerance: float) -> bool:
    if x.dtype != y.dtype or x.shape != y.shape:
        return False
    if x.dtype.kind == "f":
        return bool(np.allclose(x[()], y[()], rtol=0, atol=tolerance, equal_nan=True))
    return bool(np.array_equal(x[()], y[()]))

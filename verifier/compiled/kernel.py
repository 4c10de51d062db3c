"""Kernels: traced programs, compiled when first called, on arrays."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from verifier.compiled.emit import assembly
from verifier.compiled.native import processor
from verifier.compiled.trace import Array, Index, Trace, Value

#: What a kernel computes, for some sizes (such as the number of error symbols): its outputs, or
#: these and a description of them for the caller.
Build = Callable[..., Sequence[Value] | tuple[Sequence[Value], Any]]


class Kernel:
    """A program with parameters, see ``Trace``.

    outputs: how many numbers it gives a place; shapes: how its builder describes them.
    """

    def __init__(self, name: str, build: Build, *sizes: object) -> None:
        self.trace = Trace()
        built = build(self.trace, *sizes)
        values, self.shapes = built if isinstance(built, tuple) else (built, None)
        self.values = list(values)
        self.outputs = len(self.values)
        self._widths = [
            (table.width, 0 if table.index is None else table.index + 1)
            for table in self.trace.tables
        ]
        self._count = 3 + 2 * len(self._widths) + self.trace.indices
        self._name = name
        self._function: Callable[..., None] | None = None

    def __call__(
        self,
        places: int,
        tables: Sequence[Array],
        indices: Sequence[Index] = (),
        out: Array | None = None,
    ) -> Array:
        """Return the outputs ``[outputs, places]``, in ``out`` if it is given.

        tables: arrays ``[width, places or more]`` in the order of their parameters, copied
        unless their last axis is contiguous; indices: ``[places]`` each. ``out`` may not overlap
        with them.
        """
        if out is None:
            out = np.empty((self.outputs, places))
        if not places:
            return out
        if self._function is None:
            self._function = self._compile()
        # Wrong addresses would be read without notice.
        if out.shape != (self.outputs, places) or not _readable(out):
            raise ValueError(f"kernel {self._name}: the output's array does not fit")
        values = [places, _address(out), out.strides[0] >> 3]
        sizes, addresses, copies = [places], [], []
        for index in indices:
            if index.shape != (places,) or index.dtype != np.intp or not index.flags.c_contiguous:
                raise ValueError(f"kernel {self._name}: an index does not fit")
            # As unsigned numbers the negative ones are beyond all others.
            sizes.append(int(index.view(np.uintp).max()) + 1)
            addresses.append(_address(index))
        if len(tables) != len(self._widths) or len(addresses) != self.trace.indices:
            raise ValueError(f"kernel {self._name}: wrong number of arrays")
        for table, (width, place) in zip(tables, self._widths, strict=True):
            rows, columns = table.shape
            if rows != width or columns < sizes[place]:
                raise ValueError(f"kernel {self._name}: an array {table.shape} does not fit")
            if not _readable(table):
                table = np.ascontiguousarray(table, dtype=np.float64)  # noqa: PLW2901
                copies.append(table)
            values.append(_address(table))
            values.append(table.strides[0] >> 3)
        self._function(*values, *addresses)
        return out

    def _compile(self) -> Callable[..., None]:
        target = processor()
        return target.function(assembly(self.trace, self.values, target.lanes), self._count)


def _readable(table: np.ndarray) -> bool:
    """Tell whether an array is of doubles, each row contiguous."""
    row, item = table.strides
    return table.dtype == np.float64 and (item == 8 or table.shape[1] <= 1) and row % 8 == 0


#: In NumPy's C interface an array's data pointer follows the object's head.
_HEAD = object.__basicsize__
_POINTER = ctypes.c_size_t


def _address_quickly(array: np.ndarray) -> int:
    return _POINTER.from_address(id(array) + _HEAD).value


def _address_slowly(array: np.ndarray) -> int:
    return array.ctypes.data


def _quick_address_works() -> bool:
    """Tell whether arrays lie in memory as NumPy's C interface says, here too."""
    probes = [np.empty(3), np.empty((2, 5))[1:, 2:], np.empty(7, dtype=np.intp)]
    inside = np.ndarray.__basicsize__ >= _HEAD + ctypes.sizeof(_POINTER)
    return (
        sys.implementation.name == "cpython"
        and inside
        and all(_address_quickly(a) == _address_slowly(a) for a in probes)
    )


_address = _address_quickly if _quick_address_works() else _address_slowly


_KNOWN: dict[tuple, Kernel] = {}


def kernel(build: Build) -> Callable[..., Kernel]:
    """Decorate ``build(trace, *sizes)`` so that ``build(*sizes)`` returns its kernel."""

    def get(*sizes: object) -> Kernel:
        key = (build, *sizes)
        found = _KNOWN.get(key)
        if found is None:
            found = _KNOWN[key] = Kernel(build.__name__, build, *sizes)
        return found

    return get


def forget() -> None:
    """Forget all kernels: they are traced anew, with today's constants (for tests)."""
    _KNOWN.clear()

"""Gathering the errors of a state between steps: Lohner's method, as one kernel.

The error set is enclosed in an orthogonal frame Q that follows its longest directions, so that
it does not grow by being boxed anew at every step. The extent along each axis of Q is a sum of
|a + b x|, convex in x, so it lies below the straight line between its values at x = -1 and 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from verifier.arithmetic import Model, read, total_size
from verifier.compiled.kernel import kernel
from verifier.compiled.trace import Trace, Value, maximum, square_root, where
from verifier.compiled.trace import total as summed
from verifier.models import TERMS, Models
from verifier.rounding import TINY, UP

#: A column whose square is below this is taken for 0: the frame stays as it is.
_NOTHING = 1e-280

Vector = list[Value]


def consolidate(state: Models, active: Sequence[int], carried: int = 0) -> Models:
    """Gather the errors of the state ``[4, rows]`` into one error symbol per active component.

    The first ``carried`` symbols stay as they are; those gathered follow them. Errors of
    components that are not active go into their radii.
    """
    components, rows = state.radius.shape
    program = _gather(state.symbols, components, tuple(active), carried)
    tables = [
        table for i in range(components) for table in (state.c[:, i], state.radius[i : i + 1])
    ]
    out = program(rows, tables).reshape(program.outputs // components, components, rows)
    return Models(out[:-1], out[-1])


@kernel
def _gather(
    trace: Trace, symbols: int, components: int, active: tuple[int, ...], carried: int
) -> list[Value]:
    """Coefficients ``[TERMS + 2 (carried + active), components]``, then the radii."""
    state = [read(trace, symbols) for _ in range(components)]
    first, zero = TERMS + 2 * carried, trace.number(0.0)
    moving = [state[i] for i in active]
    columns = range(first, TERMS + 2 * symbols, 2)
    frame = _frame([[z.c[j] for z in moving] for j in columns], len(active), trace)
    turned = [
        [(_dot(axis, [z.c[j + n] for z in moving])) for n in (0, 1)]
        for axis in frame
        for j in columns
    ]
    gathered: list[dict[int, Value]] = []
    for i, axis in enumerate(frame):
        mine = turned[i * len(columns) : (i + 1) * len(columns)]
        extent = summed([abs(x) * z.radius for x, z in zip(axis, moving, strict=True)])
        right = (summed([extent, *(abs(a + b) for a, b in mine)])) * UP
        left = (summed([extent, *(abs(a - b) for a, b in mine)])) * UP
        half_sum, half_difference = (right + left) * 0.5 * UP, (right - left) * 0.5
        for size in (half_sum, half_difference):
            gathered.append({k: x * size for k, x in zip(active, axis, strict=True)})
    radii = dict(zip(active, _radii(frame, moving, first), strict=True))
    out = [z.c[j] for j in range(first) for z in state]
    out += [row.get(k, zero) for row in gathered for k in range(components)]
    return out + [radii.get(k, _boxed(state[k], first)) for k in range(components)]


def _boxed(z: Model, first: int) -> Value:
    """Return the radius with the symbols from ``first`` on."""
    size = total_size(z.c[first:]) + z.radius * 0.0
    return where(size <= 0.0, z.radius, (z.radius + size) * UP)


def _radii(frame: list[Vector], moving: list[Model], first: int) -> list[Value]:
    """Return the radii of the active components.

    A vector e is Q (Q^T e) + (I - Q Q^T) e; the second part is what Q lacks in being orthogonal,
    bounded row by row. All products round as well: Q's rows are no longer than the square root
    of 1 + lack, near 1, however Q was found.
    """
    places = range(len(moving))
    lack = [
        [abs(_dot([q[k] for q in frame], [q[m] for q in frame]) - float(k == m)) for m in places]
        for k in places
    ]
    most = lack[0][0]
    for row in lack:
        for x in row:
            most = maximum(x, most)
    rounding = 2.0**-48 * (1.0 + most)
    sizes = [(total_size(z.c[first:]) + z.radius) * UP for z in moving]
    loose = rounding * summed(sizes)
    return [
        (summed([(x + rounding) * size for x, size in zip(row, sizes, strict=True)]) * UP + loose)
        * UP
        + TINY
        for row in lack
    ]


def _dot(a: Vector, b: Vector) -> Value:
    return summed([x * y for x, y in zip(a, b, strict=True)])


def _frame(columns: list[Vector], size: int, trace: Trace) -> list[Vector]:
    """Return axes, nearly orthogonal: Householder's QR, the column that reaches farthest first.

    Nothing is promised of them.
    """
    # Row k of the frame: component k along each axis.
    frame = [[trace.number(float(i == k)) for i in range(size)] for k in range(size)]
    for j in range(min(len(columns), size - 1)):
        square, pivot, *columns = _longest_first(columns, j)
        x = pivot[j:]
        length = square_root(square)
        v = [x[0] + where(x[0] > 0.0, length, -length), *x[1:]]
        own = _dot(v, v)
        share = where(own > _NOTHING, 2.0 / own, 0.0)

        def reflected(y: Vector, j: int = j, v: Vector = v, share: Value = share) -> Vector:
            along = share * _dot(v, y[j:])
            return [*y[:j], *(a - along * b for a, b in zip(y[j:], v, strict=True))]

        columns = [reflected(y) for y in columns]
        frame = [reflected(row) for row in frame]
    return [[row[i] for row in frame] for i in range(size)]


def _longest_first(columns: list[Vector], first: int) -> Any:
    """Return the square of the longest column, from component ``first`` on, and the columns."""
    items = [[_dot(c[first:], c[first:]), *c] for c in columns]
    for i in range(1, len(items)):
        swap = items[i][0] > items[0][0]
        pairs = list(zip(items[0], items[i], strict=True))
        items[0] = [where(swap, b, a) for a, b in pairs]
        items[i] = [where(swap, a, b) for a, b in pairs]
    return [items[0][0], *(item[1:] for item in items)]

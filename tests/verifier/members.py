"""Which vectors are members of a state's Taylor models: found by linear programmes."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from verifier.models import TERMS, Models

#: How often x is improved where it is not known.
_ROUNDS = 8


def inside(
    state: Models, values: np.ndarray, places: np.ndarray | None, slack: float
) -> tuple[np.ndarray, np.ndarray]:
    """Tell which values ``[4, N]`` are members of models ``[4]``, up to ``slack``.

    places: ``[N]``, the x of each, or None if any in [-1, 1] will do. Returns also how far the
    values are off the polynomial at their x, ``[4, N]`` (at x = 0 if it is not known).
    """
    count = values.shape[1]
    x = np.zeros(count) if places is None else places
    off = np.abs(values - _polynomial(state, x))
    room = state.radius + slack
    reach = np.abs(state.c[1:]).sum(axis=0) + room
    held = np.zeros(count, dtype=bool)
    near = (np.abs(values.T - state.c[0]) <= reach).all(axis=1)
    if places is not None and count:
        held = near & _plainly(state, values - _polynomial(state, x), x, room)
    for n in np.flatnonzero(near & ~held):
        held[n] = _member(state, values[:, n], None if places is None else float(x[n]), room)
    return held, off


def _plainly(state: Models, off: np.ndarray, x: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Tell of which values ``[4, N]`` the shortest vector of symbols that fits will do."""
    columns = state.c[TERMS::2, :, None] + state.c[TERMS + 1 :: 2, :, None] * x
    columns = columns.transpose(2, 1, 0)  # [N, 4, m]
    e = np.clip(np.linalg.pinv(columns) @ off.T[:, :, None], -1, 1)
    return (np.abs(off.T - (columns @ e)[:, :, 0]) <= room).all(axis=1)


def _polynomial(state: Models, x: np.ndarray) -> np.ndarray:
    return state.c[:TERMS].T @ (x ** np.arange(TERMS)[:, None])


def _member(state: Models, value: np.ndarray, place: float | None, room: np.ndarray) -> bool:
    """Look for symbols, and x if it is not given, that come within ``room`` of a value."""
    if place is not None:
        off, columns = _at(state, value, place)
        _, e = _closest(columns, np.zeros(4), off, room, 0.0)
        return bool((np.abs(off - columns @ e) <= room).all())
    for improve in (_closest_quickly, _closest):
        x = 0.0
        for _ in range(_ROUNDS):
            off, columns = _at(state, value, x)
            slope = (np.arange(1, TERMS) * x ** np.arange(TERMS - 1)) @ state.c[1:TERMS]
            move, e = improve(columns, slope, off, room, x)
            x = float(np.clip(x + move, -1, 1))
            off, columns = _at(state, value, x)
            if (np.abs(off - columns @ e) <= room).all():
                return True
            if abs(move) < 1e-9:
                break
    return False


def _closest_quickly(
    columns: np.ndarray, slope: np.ndarray, off: np.ndarray, room: np.ndarray, x: float
) -> tuple[float, np.ndarray]:
    """Return the shortest vector of the move of x and the symbols that comes close, clipped."""
    del room
    # About x = 0, so that the whole of x is kept short.
    y = _least_squares(np.concatenate([slope[:, None], columns], axis=1), off + slope * x)
    y = np.clip(y, -1, 1)
    return float(y[0]) - x, y[1:]


def _at(state: Models, value: np.ndarray, x: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what the polynomial leaves of a value, and the symbols' columns ``[4, m]`` at x."""
    off = value - (x ** np.arange(TERMS)) @ state.c[:TERMS]
    return off, (state.c[TERMS::2] + state.c[TERMS + 1 :: 2] * x).T


def _least_squares(columns: np.ndarray, off: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(columns, off, rcond=None)[0]


def _closest(
    columns: np.ndarray, slope: np.ndarray, off: np.ndarray, room: np.ndarray, x: float
) -> tuple[float, np.ndarray]:
    """Return the move of x and the symbols that come closest, in multiples of ``room``."""
    m = columns.shape[1]
    # Variables: the move, the symbols, and the multiple t: |off - slope move - C e| <= t room.
    scale = np.maximum(np.abs(columns).sum(axis=1) + np.abs(slope), room)
    rows = np.concatenate([slope[:, None], columns], axis=1) / scale[:, None]
    given, wide = off / scale, (room / scale)[:, None]
    a = np.block([[rows, -wide], [-rows, -wide]])
    bounds = [(-1 - x, 1 - x), *[(-1, 1)] * m, (0, None)]
    cost = np.zeros(m + 2)
    cost[-1] = 1.0
    found = linprog(cost, a, np.concatenate([given, -given]), bounds=bounds, method="highs")
    if found.x is None:
        return 0.0, np.zeros(m)
    return float(found.x[0]), found.x[1:-1]

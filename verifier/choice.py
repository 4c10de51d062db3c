"""Which face each ray meets, seen from the middle of each row, and what must hold for that.

A ray that meets face j of a wall needs: every other constraint k of that wall holds there,
and u_j is no less than 1 / range. Any other wall lies no nearer if

    the ray has, up to there, not come into one of its constraints:  u >= u_k  (g_k > 0), or
    it leaves one of them, k, before it comes into another, j:       X_jk <= 0  (g_j > 0,
                                                                     and g_k <= 0 or h_k <= 0).

The one of these that holds by most in the middle of the row is asked for on all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from verifier.models import Array
from verifier.rows import Decision
from verifier.walls import Index, Walls

#: Stands for the range instead of a face: u = 1 / range.
RANGE = -1


@dataclass(frozen=True)
class Nearer:
    """Guards u_first >= u_second; the measurement is continuous where they fail (kinks)."""

    first: Index
    second: Index
    ray: Index
    row: Index


@dataclass(frozen=True)
class Passes:
    """Guards sign X_pair >= 0; the measurement jumps where they fail."""

    pair: Index
    sign: Array
    ray: Index
    row: Index


@dataclass(frozen=True)
class Recedes:
    """Guards h_face <= 0."""

    face: Index
    ray: Index
    row: Index


@dataclass(frozen=True)
class Choice:
    """The face met ``[rays, rows]`` (or RANGE), its guards, and rows without an answer."""

    winner: Index
    nearer: Nearer
    passes: Passes
    recedes: Recedes
    unclear: NDArray[np.bool_]


class _Collector:
    """Gathers guards of one kind as flat arrays."""

    def __init__(self, columns: int) -> None:
        self._parts: list[list[NDArray]] = [[] for _ in range(columns)]

    def add(self, where: NDArray[np.bool_], *values: NDArray | float) -> None:
        ray, row = np.nonzero(where)
        columns = [
            v[ray, row] if isinstance(v, np.ndarray) else np.full(ray.shape, v) for v in values
        ]
        for part, column in zip(self._parts, [*columns, ray, row], strict=True):
            part.append(column)

    def columns(self) -> list[NDArray]:
        return [np.concatenate(p) if p else np.zeros(0, dtype=np.intp) for p in self._parts]


def choose(
    walls: Walls, cosine: Array, sine: Array, reach: float,
    decisions: Sequence[Sequence[Decision]],
) -> Choice:  # fmt: skip
    """Choose the face met by each ray (directions ``[rays]``) from the middle of each row."""
    rate, ratio, cross = walls.centres(cosine, sine)
    decided = _apply(walls, cross, decisions)
    pair_of = {}
    for p, (j, k) in enumerate(walls.pairs):
        pair_of[j, k], pair_of[k, j] = (p, 1.0), (p, -1.0)
    by_wall: dict[int, list[int]] = {}
    for j, face in enumerate(walls.faces):
        by_wall.setdefault(face.polygon, []).append(j)

    rays, rows = len(cosine), walls.low.shape[1]
    best = np.full((rays, rows), 1 / reach)
    winner = np.full((rays, rows), RANGE, dtype=np.intp)
    for faces in by_wall.values():
        for j in faces:
            hit = ratio[j] > best
            for k in faces:
                if k != j:
                    p, sign = pair_of[j, k]
                    hit &= sign * cross[p] >= 0
            best, winner = np.where(hit, ratio[j], best), np.where(hit, j, winner)

    nearer, passes, recedes = _Collector(4), _Collector(4), _Collector(3)
    unclear = np.zeros(rows, dtype=bool)
    for faces in by_wall.values():
        met = np.isin(winner, faces)
        for j in faces:
            here = winner == j
            nearer.add(here, j, RANGE)
            for k in faces:
                if k != j:
                    p, sign = pair_of[j, k]
                    kink = here & walls.usable[k]
                    nearer.add(kink, k, j)
                    passes.add(here & ~walls.usable[k] & ~decided[p], p, sign)
        options = _options(walls, faces, pair_of, best, rate, ratio, cross)
        slack = np.stack([o.slack for o in options])
        chosen = slack.argmax(axis=0)
        unclear |= np.any(~met & (slack.max(axis=0) < 0), axis=0)
        for n, option in enumerate(options):
            where = ~met & (chosen == n)
            if option.pair is None:
                nearer.add(where, winner, option.face)
                continue
            p, sign = option.pair
            passes.add(where & ~decided[p], p, -sign)
            recedes.add(where & ~(walls.high[option.face] <= 0), option.face)
    return Choice(
        winner,
        Nearer(*nearer.columns()),
        Passes(*passes.columns()),
        Recedes(*recedes.columns()),
        unclear,
    )


@dataclass(frozen=True)
class _Option:
    """A way for a wall to lie no nearer; slack ``[rays, rows]``, -inf where it cannot be used."""

    slack: Array
    face: int
    pair: tuple[int, float] | None = None


def _options(
    walls: Walls, faces: list[int], pair_of: dict[tuple[int, int], tuple[int, float]],
    best: Array, rate: Array, ratio: Array, cross: Array,
) -> list[_Option]:  # fmt: skip
    options = []
    for k in faces:
        usable = walls.usable[k]
        options.append(_Option(np.where(usable, best - ratio[k], -np.inf), k))
        for j in faces:
            if j == k:
                continue
            p, sign = pair_of[j, k]
            slack = -sign * cross[p] / np.maximum(walls.miss_centre[j], 1e-3)
            slack = np.where(walls.high[k] <= 0, slack, np.minimum(slack, -rate[k]))
            options.append(_Option(np.where(walls.low[j] > 0, slack, -np.inf), k, (p, sign)))
    return options


def _apply(
    walls: Walls, cross: Array, decisions: Sequence[Sequence[Decision]]
) -> NDArray[np.bool_]:
    """Force the crosses that rows assume; return which ``[pairs, rays, rows]`` they are."""
    decided = np.zeros(cross.shape, dtype=bool)
    if not any(decisions):
        return decided
    place = {
        (walls.faces[j].polygon, walls.faces[j].place, walls.faces[k].place): p
        for p, (j, k) in enumerate(walls.pairs)
    }
    for row, assumed in enumerate(decisions):
        for d in assumed:
            p = place.get((d.polygon, d.front, d.back))
            if p is not None:
                cross[p, d.ray, row] = np.inf if d.positive else -np.inf
                decided[p, d.ray, row] = True
    return decided

"""Which face each ray meets, seen from the middle of each row, and what must hold for that.

A ray that meets face j of a wall needs: every other constraint k of that wall holds there,
and u_j is no less than 1 / range. Any other wall lies no nearer if

    the ray has, up to there, not come into one of its constraints:  u >= u_k  (g_k > 0), or
    it leaves one of them, k, before it comes into another, j:       X_jk <= 0  (g_j > 0,
                                                                     and g_k <= 0 or h_k <= 0).

The one of these that holds by most in the middle of the row is asked for on all of it.

What must hold is a guard G >= 0 with a code:

    nearer (a, b):  u_a >= u_b, of faces or the range; the measurement is continuous where it
                    fails (a kink)
    passes (p, +-): X_p >= 0 or X_p <= 0; the measurement jumps where it fails
    recedes k:      h_k <= 0
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from verifier.compiled.kernel import kernel
from verifier.compiled.trace import Trace, Value, maximum, minimum, where
from verifier.models import Array
from verifier.rows import Assumption, Decision
from verifier.walls import RANGE, Faces, Index, Walls, grid, usable


class Codes:
    """The codes of guards among ``count`` faces and ``pairs`` cross products; 0 is no guard."""

    def __init__(self, count: int, pairs: int) -> None:
        self._count = count
        self.passes_from = 1 + (count + 1) ** 2
        self.recedes_from = self.passes_from + 2 * pairs
        self.end = self.recedes_from + count

    def nearer(self, a: Any, b: Any) -> Any:
        """Return the code of u_a >= u_b, of numbers or Values; RANGE is a face, too."""
        return (a + 1) * (self._count + 1) + (b + 2)

    def nearer_faces(self, code: Index) -> tuple[Index, Index]:
        """Return a and b of a code of ``nearer``."""
        a, b = np.divmod(code - 1, self._count + 1)
        return a - 1, b - 1

    def passes(self, pair: int, positive: bool) -> int:
        """Return the code of X_pair >= 0, or <= 0."""
        return self.passes_from + 2 * pair + (1 - positive)

    def recedes(self, face: int) -> int:
        """Return the code of h_face <= 0."""
        return self.recedes_from + face


class Meaning:
    """What each code asks for: sign x (an entry of the walls' table) + constant / range >= 0.

    entry, sign, constant: ``[codes]``.
    """

    def __init__(self, faces: Faces) -> None:
        self.codes = codes = Codes(faces.count, len(faces.pairs))
        self.entry = np.zeros(codes.end, dtype=np.intp)
        self.sign = np.ones(codes.end)
        self.constant = np.zeros(codes.end)
        for j in range(faces.count):
            self._set(codes.nearer(j, RANGE), faces.ratios + j, 1.0, -1.0)
            self._set(codes.nearer(RANGE, j), faces.ratios + j, -1.0, 1.0)
            self._set(codes.recedes(j), j, -1.0)
        for n, (j, k) in enumerate(faces.twos):
            self._set(codes.nearer(j, k), faces.differences + n, 1.0)
            self._set(codes.nearer(k, j), faces.differences + n, -1.0)
        #: The cross product and the sign that say whether constraint k holds where j is met.
        self.cross_of = {}
        for p, (j, k) in enumerate(faces.pairs):
            self.cross_of[j, k], self.cross_of[k, j] = (p, True), (p, False)
            self._set(codes.passes(p, True), faces.crosses + p, 1.0)
            self._set(codes.passes(p, False), faces.crosses + p, -1.0)
        self.place = {
            (faces.faces[j].polygon, faces.faces[j].place, faces.faces[k].place): p
            for p, (j, k) in enumerate(faces.pairs)
        }

    def _set(self, code: int, entry: int, sign: float, constant: float = 0.0) -> None:
        self.entry[code], self.sign[code], self.constant[code] = entry, sign, constant


@dataclass(frozen=True)
class Choice:
    """What rays meet: ``winner`` ``[rays x rows]``, faces or RANGE.

    code, ray, row: guards ``[N]``; unclear: ``[rows]``, rows without an answer.
    """

    winner: Index
    code: Index
    ray: Index
    row: Index
    unclear: NDArray[np.bool_]


def choose(
    walls: Walls, meaning: Meaning, directions: Array, reach: float,
    decisions: Sequence[Sequence[Assumption]], forced: NDArray[np.bool_],
) -> Choice:  # fmt: skip
    """Choose the face met by each ray from the middle of each row.

    directions: ``[2 or more, rays]``, cosine and sine first; forced: ``[rows]``, for which it may
    stay open whether a wall is met, if only one of its faces says how near at most.
    """
    faces, rows = walls.faces, walls.rows
    rays = directions.shape[1]
    ray, row = grid(rays, rows)
    decided = _decided(walls, meaning, rays, decisions)
    program = _choice(faces.walls, faces.count, len(faces.twos), reach, decided is not None)
    near = np.concatenate([walls.low, walls.high, walls.miss_centre, forced[None].astype(float)])
    tables = [directions[:2], walls.centres, near]
    found = program(len(ray), tables if decided is None else [*tables, decided], [ray, row])
    slots = found[2:].ravel()
    at = np.flatnonzero(slots)
    places = at % len(ray)
    return Choice(
        found[0].astype(np.intp),
        slots[at].astype(np.intp),
        ray[places],
        row[places],
        found[1].reshape(rays, rows).any(axis=0),
    )


def _decided(
    walls: Walls, meaning: Meaning, rays: int, decisions: Sequence[Sequence[Assumption]]
) -> Array | None:
    """Return the signs of cross products that rows assume ``[pairs, rays x rows]``, else 0."""
    if not any(decisions):
        return None
    rows = walls.rows
    decided = np.zeros((len(meaning.place), rays * rows))
    for row, assumed in enumerate(decisions):
        for d in assumed:
            if not isinstance(d, Decision):
                continue
            p = meaning.place.get((d.polygon, d.front, d.back))
            if p is not None:
                decided[p, d.ray * rows + row] = 1.0 if d.positive else -1.0
    return decided if len(decided) else None


@kernel
def _choice(
    trace: Trace, walls: tuple[tuple[int, ...], ...], count: int, twos: int, reach: float,
    with_decided: bool,
) -> list[Value]:  # fmt: skip
    """The face met, whether that is unclear, and the codes of guards, of a ray and a row."""
    ray, row = trace.index(), trace.index()
    view = _View(trace, ray, row, walls, count, twos)
    if with_decided:
        view.assume(trace.table(len(view.cross)))
    best, winner = trace.number(1 / reach), trace.number(float(RANGE))
    for members in walls:
        for j in members:
            hit = view.ratio[j] > best
            for k in members:
                if k != j:
                    hit = hit & (view.inside(j, k) >= 0.0)
            best = where(hit, view.ratio[j], best)
            winner = where(hit, float(j), winner)
    guards = _guards_of_winner(view, walls, winner)
    unclear = trace.number(0.0)
    for members in walls:
        met = (winner >= float(members[0])) & (winner <= float(members[-1]))
        slack, code, recedes = _beyond(view, members, best, winner)
        unclear = where(~met & (slack < 0.0), 1.0, unclear)
        guards += [where(met, 0.0, code), where(met, 0.0, recedes)]
    return [winner, unclear, *guards]


class _View:
    """What a ray sees from the middle of a row.

    rate, ratio (-inf where not usable), miss: of each face; cross: X of each pair; assumed: 0,
    or the sign of X that the row assumes.
    """

    def __init__(
        self, trace: Trace, ray: int, row: int, walls: tuple[tuple[int, ...], ...], count: int,
        twos: int,
    ) -> None:  # fmt: skip
        pairs = sum(len(members) * (len(members) - 1) // 2 for members in walls)
        entries = 2 * count + twos + pairs
        cosine, sine = trace.table(2, ray)
        centres = trace.table(2 * entries, row)
        combined = [
            cosine * a + sine * b for a, b in zip(centres[:entries], centres[entries:], strict=True)
        ]
        near = trace.table(3 * count + 1, row)
        self.low, self.high, self.miss = (near[i * count : (i + 1) * count] for i in range(3))
        self.forced = near[-1] > 0.0
        self.usable = [usable(*x) for x in zip(self.low, self.high, strict=True)]
        self.rate = combined[:count]
        self.ratio = [
            where(known, x, -np.inf)
            for known, x in zip(self.usable, combined[count : 2 * count], strict=True)
        ]
        self.cross = combined[2 * count + twos :]
        self.assumed = [trace.number(0.0)] * pairs
        self.codes = Codes(count, pairs)
        order = [pair for members in walls for pair in _pairs(members)]
        self.pair = {pair: p for p, pair in enumerate(order)}

    def assume(self, signs: list[Value]) -> None:
        """Let cross products have the signs that a row assumes."""
        self.assumed = signs
        self.cross = [
            where(sign > 0.0, np.inf, where(sign < 0.0, -np.inf, x))
            for sign, x in zip(signs, self.cross, strict=True)
        ]

    def inside(self, j: int, k: int) -> Value:
        """Return what is >= 0 where constraint k holds as the ray meets j."""
        return self.cross[self.pair[j, k]] if j < k else -self.cross[self.pair[k, j]]

    def passes(self, j: int, k: int, positive: bool) -> Value:
        """Return the code of ``inside`` >= 0 (or <= 0); 0 where the row assumes it."""
        p = self.pair[min(j, k), max(j, k)]
        code = self.codes.passes(p, positive == (j < k))
        return where(abs(self.assumed[p]) > 0.0, 0.0, float(code))


def _pairs(members: tuple[int, ...]) -> list[tuple[int, int]]:
    return [(j, k) for j in members for k in members if j < k]


def _guards_of_winner(
    view: _View, walls: tuple[tuple[int, ...], ...], winner: Value
) -> list[Value]:
    """Return codes: within range, and inside the other constraints of its wall."""
    zero = winner.trace.number(0.0)
    most = max(len(members) for members in walls)
    guards = [where(winner >= 0.0, view.codes.nearer(winner, RANGE), 0.0)]
    others = [zero] * (most - 1)
    for members in walls:
        for j in members:
            here = abs(winner - float(j)) < 0.5
            for slot, k in enumerate(k for k in members if k != j):
                kink = float(view.codes.nearer(k, j))
                code = where(view.usable[k], kink, view.passes(j, k, True))
                others[slot] = where(here, code, others[slot])
    return guards + others


def _beyond(
    view: _View, members: tuple[int, ...], best: Value, winner: Value
) -> tuple[Value, Value, Value]:
    """Return the best way for a wall to lie no nearer than ``best``: slack, codes of guards."""
    zero = best.trace.number(0.0)
    options = []
    nearest, nearest_code = best.trace.number(-np.inf), zero
    for k in members:
        slack = where(view.usable[k], best - view.ratio[k], -np.inf)
        options.append((slack, view.codes.nearer(winner, k), zero))
        better = slack > nearest
        nearest = where(better, slack, nearest)
        nearest_code = where(better, options[-1][1], nearest_code)
        for j in members:
            if j == k:
                continue
            slack = -view.inside(j, k) / maximum(view.miss[j], 1e-3)
            outside = view.high[k] <= 0.0
            slack = where(outside, slack, minimum(slack, -view.rate[k]))
            slack = where(view.low[j] > 0.0, slack, -np.inf)
            recedes = where(outside, 0.0, float(view.codes.recedes(k)))
            options.append((slack, view.passes(j, k, False), recedes))
    slack, code, recedes = options[0]
    for other, other_code, other_recedes in options[1:]:
        better = other > slack
        slack = where(better, other, slack)
        code = where(better, other_code, code)
        recedes = where(better, other_recedes, recedes)
    force = view.forced & (slack < 0.0) & (nearest > -np.inf)
    return where(force, 0.0, slack), where(force, nearest_code, code), where(force, 0.0, recedes)

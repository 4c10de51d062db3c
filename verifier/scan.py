"""The LiDAR on Taylor models: measurements, and the guards that they rest on.

Where a guard may fail on part of a row, there are two cases. If the measurement is
continuous there (a kink: a corner, the range) and the failure is small, it is enclosed as it is
(verifier.kinks). If it jumps (the inner corner), or the failure is large, the row has to be cut
(verifier.cuts).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from racecar.lidar import Lidar
from racecar.polygon import Polygon
from verifier.arithmetic import Model, bounds, norm, read_joined
from verifier.choice import Choice, Meaning, choose
from verifier.chords import clipped_reciprocal
from verifier.compiled.kernel import Kernel, kernel
from verifier.compiled.trace import Trace, Value, where
from verifier.elementary import SIN_COS_ERROR, sin_cos
from verifier.functions import reciprocal
from verifier.kinks import Bends, Kinks, bends
from verifier.models import TERMS, Array, Models
from verifier.rounding import UP, U
from verifier.rows import Assumption, Decision, Rows
from verifier.walls import RANGE, Faces, Index, Obstacles, Walls, grid


@dataclass(frozen=True)
class Guards:
    """Guards G >= 0 that may fail, one per entry.

    models: of G, ``[N]``; fails: ``[N]``, by how much at most, or the radius (1/m) that a kink
    would cost; row: ``[N]``; decisions: what the part where G >= 0 assumes, for jumps; None for
    kinks and where nothing can be assumed.
    """

    models: Models
    fails: Array
    row: Index
    decisions: tuple[Assumption | None, ...]


@dataclass(frozen=True)
class Scan:
    """Measurements: models ``[rays, rows]`` (metres); valid for the rows without guards.

    unclear: ``[rows]``, rows too wide to tell from their middle what the rays meet.
    """

    distance: Models
    guards: Guards
    unclear: NDArray[np.bool_]


class Scanner:
    """The LiDAR among the obstacles of one frame."""

    def __init__(self, lidar: Lidar, obstacles: Sequence[Polygon]) -> None:
        self._reach = lidar.range
        self._obstacles = Obstacles(obstacles)
        sine, cosine = sin_cos(lidar.angles)
        # The angles are -fov/2 + i fov/(n - 1) to within 4 U fov.
        error = SIN_COS_ERROR + 4 * U * lidar.field_of_view
        self._directions = np.array([cosine, sine, np.full(lidar.rays, error)])

    def measure(self, rows: Rows, kink: float) -> Scan:
        """Return measurements; kinks of up to ``kink`` (1/m), or the row's own, are kept.

        A kink's size is the radius of the inverse distance that it costs.
        """
        faces = self._obstacles.within(rows.state, self._reach)
        meaning = _meaning(faces)
        walls = Walls(faces, rows.state)
        forced = np.isinf(rows.kink)
        choice = choose(walls, meaning, self._directions, self._reach, rows.decisions, forced)
        guards, bent = self._guards(walls, meaning, choice, np.maximum(rows.kink, kink))
        return Scan(self._distances(walls, choice.winner, bent), guards, choice.unclear)

    def _guards(
        self, walls: Walls, meaning: Meaning, choice: Choice, allowed: Array
    ) -> tuple[Guards, Bends | None]:
        """Return the guards that may fail, and what small kinks make of their rays."""
        low, high = self._evaluate(_range, walls, meaning, choice.code, choice.ray, choice.row)
        fail = np.flatnonzero(~(low >= 0))  # NaN, from overflow, proves nothing
        if not fail.size:
            return _none(walls.symbols), None
        code, ray, row = choice.code[fail], choice.ray[fail], choice.row[fail]
        needs = -low[fail]
        bent, small = None, np.zeros(len(fail), dtype=bool)
        kinks = np.flatnonzero(code < meaning.codes.passes_from)
        if kinks.size:
            places = ray[kinks] * walls.rows + row[kinks]
            with np.errstate(invalid="ignore", over="ignore"):
                found = self._kinks(
                    walls, meaning, code[kinks], places, choice.winner, low[fail[kinks]],
                    high[fail[kinks]],
                )  # fmt: skip
                fit = found.cost <= allowed[row[kinks]]
            needs[kinks] = found.cost
            # Where the wall met is entered later than face b says, it must not be left by then:
            # that would be a jump.
            some = np.flatnonzero(fit)
            index = kinks[some]
            fit[some[self._may_leave(walls, meaning, code[index], ray[index], row[index])]] = False
            small[kinks] = fit
            if fit.any():
                bent = bends(found.take(fit), _beyond(walls, meaning, choice, low))
        left = np.flatnonzero(~small)
        left = left[np.argsort(code[left] >= meaning.codes.passes_from, kind="stable")]
        code, ray, row = code[left], ray[left], row[left]
        out = self._evaluate(_guard, walls, meaning, code, ray, row)
        decisions = tuple(
            _decision(walls.faces, meaning, int(c), int(r)) for c, r in zip(code, ray, strict=True)
        )
        return Guards(Models(out[:-1], out[-1]), needs[left], row, decisions), bent

    def _kinks(
        self, walls: Walls, meaning: Meaning, code: Index, places: Index, winner: Index,
        least: Array, most: Array,
    ) -> Kinks:  # fmt: skip
        a, b = meaning.codes.nearer_faces(code)
        inwards = winner[places] == b
        sure = np.ones(len(code), dtype=bool)
        several = np.isin(b, [k for wall in walls.faces.walls if len(wall) > 1 for k in wall])
        asked = np.flatnonzero(several & ~inwards)
        sure[asked] = self._surely_hit(walls, meaning, b[asked], places[asked])
        return Kinks(places, np.where(inwards, a, b), inwards, least, most, sure)

    def _surely_hit(
        self, walls: Walls, meaning: Meaning, face: Index, places: Index
    ) -> NDArray[np.bool_]:
        """Tell whether the other constraints of a face's wall hold where a ray meets the face."""
        asked: list[tuple[int, int]] = []
        for n, (k, place) in enumerate(zip(face.tolist(), places.tolist(), strict=True)):
            wall = next(members for members in walls.faces.walls if k in members)
            for i in wall:
                if i == k:
                    continue
                if walls.usable[i, place % walls.rows]:
                    asked.append((n, meaning.codes.nearer(i, k)))
                else:
                    asked.append((n, meaning.codes.passes(*meaning.cross_of[k, i])))
        hit = np.ones(len(face), dtype=bool)
        if asked:
            which, codes = (np.array(x, dtype=np.intp) for x in zip(*asked, strict=True))
            ray, row = np.divmod(places[which], walls.rows)
            low, _ = self._evaluate(_range, walls, meaning, codes, ray, row)
            hit[which[~(low >= 0)]] = False
        return hit

    def _evaluate(
        self, kind: Callable[..., Kernel], walls: Walls, meaning: Meaning, code: Index, ray: Index,
        row: Index,
    ) -> Array:  # fmt: skip
        """Return what a kernel (``_guard``, ``_range``) says of guards, ``[outputs, N]``."""
        tables = [
            walls.table,
            self._directions,
            meaning.sign[code][None],
            meaning.constant[code][None],
        ]
        entry = meaning.entry[code] * walls.rows + row
        return kind(walls.symbols, self._reach)(len(code), tables, [entry, ray])

    def _may_leave(
        self, walls: Walls, meaning: Meaning, code: Index, ray: Index, row: Index
    ) -> NDArray[np.bool_]:
        """Tell of kinks whether the ray may have left the wall before it enters face a.

        Only through a face of the wall that the car may be inside of; never where a and b are
        of two walls, or one is the range.
        """
        asked: list[tuple[int, int]] = []
        for n, (late, early) in enumerate(zip(*meaning.codes.nearer_faces(code), strict=True)):
            if RANGE in {late, early}:
                continue
            wall = next(members for members in walls.faces.walls if late in members)
            if early not in wall:
                continue
            for k in wall:
                if k not in {late, early} and not walls.usable[k, row[n]]:
                    pair, positive = meaning.cross_of[late, k]
                    asked.append((n, meaning.codes.passes(pair, positive)))
        leave = np.zeros(len(code), dtype=bool)
        if asked:
            which, passes = (np.array(x, dtype=np.intp) for x in zip(*asked, strict=True))
            low, _ = self._evaluate(_range, walls, meaning, passes, ray[which], row[which])
            leave[which[~(low >= 0)]] = True
        return leave

    def _distances(self, walls: Walls, winner: Index, bent: Bends | None) -> Models:
        rows, rays = walls.rows, self._directions.shape[1]
        ray, row = grid(rays, rows)
        entry = (walls.faces.ratios + np.maximum(winner, 0)) * rows + row
        tables = [walls.table, self._directions, winner.astype(float)[None]]
        out = _distance(walls.symbols, self._reach, walls.wide)(len(ray), tables, [entry, ray])
        if bent is not None:
            self._bend(walls, winner, bent, out)
        return Models(out[:-1].reshape(-1, rays, rows), out[-1].reshape(rays, rows))

    def _bend(self, walls: Walls, winner: Index, bent: Bends, out: Array) -> None:
        """Write the measurements at places with kinks."""
        ray, row = np.divmod(bent.place, walls.rows)
        faces = winner[bent.place], bent.other
        entries = [(walls.faces.ratios + np.maximum(f, 0)) * walls.rows + row for f in faces]
        numbers = np.array([faces[0], faces[1], bent.share, bent.middle, bent.slack])
        program = _bent(walls.symbols, self._reach)
        tables = [walls.table, self._directions, walls.table, self._directions, numbers]
        out[:, bent.place] = program(len(ray), tables, [entries[0], ray, entries[1], ray])


@lru_cache(maxsize=1024)
def _meaning(faces: Faces) -> Meaning:
    return Meaning(faces)


def _beyond(walls: Walls, meaning: Meaning, choice: Choice, low: Array) -> Array:
    """Return the least of the bounds ``low`` of each place's guards u_met >= u_other."""
    nearer = np.flatnonzero(choice.code < meaning.codes.passes_from)
    places = choice.ray[nearer] * walls.rows + choice.row[nearer]
    met, _ = meaning.codes.nearer_faces(choice.code[nearer])
    outwards = met == choice.winner[places]
    least = np.full(len(choice.winner), np.inf)
    np.minimum.at(least, places[outwards], low[nearer[outwards]])
    return least


def _none(symbols: int) -> Guards:
    c = np.zeros((TERMS + 2 * symbols, 0))
    return Guards(Models(c, np.zeros(0)), np.zeros(0), np.zeros(0, dtype=np.intp), ())


def _decision(faces: Faces, meaning: Meaning, code: int, ray: int) -> Decision | None:
    codes = meaning.codes
    if not codes.passes_from <= code < codes.recedes_from:
        return None
    pair, negative = divmod(code - codes.passes_from, 2)
    front, back = (faces.faces[i] for i in faces.pairs[pair])
    return Decision(front.polygon, front.place, back.place, ray, not negative)


def _combined(trace: Trace, symbols: int) -> Model:
    """Return cos(angle) A + sin(angle) B of an entry of the walls' table, for a ray."""
    entry, ray = trace.index(), trace.index()
    a, b = read_joined(trace, symbols, 2, entry)
    cosine, sine, error = trace.table(3, ray)
    c = [cosine * x + sine * y for x, y in zip(a.c, b.c, strict=True)]
    size = (norm(a) + a.radius) + (norm(b) + b.radius)
    return Model(c, ((a.radius + b.radius) + (error + 4 * U) * size) * UP)


def _asked(trace: Trace, symbols: int, reach: float) -> Model:
    """Return sign x (an entry, combined) + constant / range."""
    model = _combined(trace, symbols)
    sign, constant = trace.column(), trace.column() * (1 / reach)
    # 1 / range is rounded by U of itself.
    model = Model([sign * x for x in model.c], model.radius)
    return model.plus(constant).widen(U * abs(constant))


@kernel
def _guard(trace: Trace, symbols: int, reach: float) -> list[Value]:
    return _asked(trace, symbols, reach).values


@kernel
def _range(trace: Trace, symbols: int, reach: float) -> list[Value]:
    return [*bounds(_asked(trace, symbols, reach))]


@kernel
def _distance(trace: Trace, symbols: int, reach: float, wide: bool) -> list[Value]:
    """The measurement of a ray that meets a face, or ends at the range."""
    inverse = _combined(trace, symbols)
    at_range = trace.column() < 0.0
    # So that 1 / u is harmless where it is not wanted.
    inverse = Model([where(at_range, 1.0, inverse.c[0]), *inverse.c[1:]], inverse.radius)
    distance = clipped_reciprocal(inverse, reach) if wide else reciprocal(inverse)
    c = [where(at_range, 0.0, x) for x in distance.c]
    c[0] = where(at_range, reach, distance.c[0])
    return [*c, where(at_range, 0.0, distance.radius)]


@kernel
def _bent(trace: Trace, symbols: int, reach: float) -> list[Value]:
    """The measurement of a ray with kinks (verifier.kinks)."""
    met, other = _combined(trace, symbols), _combined(trace, symbols)
    *faces, share, middle, slack = trace.table(5)
    parts = []
    for model, face, weight in zip((met, other), faces, (1.0 - share, share), strict=True):
        at_range = face < 0.0
        c = [where(at_range, 0.0, x) for x in model.c]
        c[0] = where(at_range, 1 / reach, model.c[0])
        # 1 / range, and 1 - share, are rounded.
        radius = where(at_range, U / reach, model.radius)
        parts.append(Model(c, radius).times(weight).widen(U * norm(model)))
    inverse = (parts[0] + parts[1]).plus(middle).widen(slack)
    return clipped_reciprocal(inverse, reach).values

"""The LiDAR on Taylor models: measurements, and the guards that they rest on.

Where a guard may fail on part of a row, there are two cases. If the measurement is
continuous there (a kink: an outer corner, the range), its inverse errs by no more than the
guard fails by; a little of that goes into the radius. If it jumps (the inner corner), or the
failure is large, the row has to be cut (verifier.cuts).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from racecar.lidar import Lidar
from racecar.polygon import Polygon
from verifier.choice import RANGE, Choice, choose
from verifier.elementary import SIN_COS_ERROR, sin_cos
from verifier.functions import reciprocal
from verifier.models import Array, Models, bounds, norm
from verifier.rounding import UP, U
from verifier.rows import Decision, Rows
from verifier.walls import Index, Walls, faces_within


@dataclass(frozen=True)
class Guards:
    """Guards G >= 0 that may fail, one per entry.

    models: of G, ``[N]``; fails: ``[N]``, by how much at most; row: ``[N]``; decisions: what
    the part where G >= 0 assumes, for jumps; None for kinks and where nothing can be assumed.
    """

    models: Models
    fails: Array
    row: Index
    decisions: tuple[Decision | None, ...]


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
        self._obstacles = obstacles
        self._sine, self._cosine = sin_cos(lidar.angles)
        # The angles are -fov/2 + i fov/(n - 1) to within 4 U fov.
        self._direction_error = SIN_COS_ERROR + 4 * U * lidar.field_of_view

    def measure(self, rows: Rows, kink: float) -> Scan:
        """Return measurements; kinks of up to ``kink`` (1/m), or the row's own, are kept."""
        walls = Walls(faces_within(self._obstacles, rows.state, self._reach), rows.state)
        choice = choose(walls, self._cosine, self._sine, self._reach, rows.decisions)
        slack = np.zeros(choice.winner.shape)
        kinks = self._kinks(walls, choice, slack, np.maximum(rows.kink, kink))
        jumps = self._jumps(walls, choice)
        return Scan(self._distances(walls, choice, slack), _join([kinks, *jumps]), choice.unclear)

    def _combine(self, pair: Models, ray: Index) -> Models:
        """Return cos(angle) pair[0] + sin(angle) pair[1]: ``[N]`` from ``[2, N]``."""
        c = self._cosine[ray] * pair.c[:, 0] + self._sine[ray] * pair.c[:, 1]
        size = (norm(pair.c) + pair.radius).sum(axis=0)
        radius = pair.radius.sum(axis=0) + (self._direction_error + 4 * U) * size
        return Models(c, radius * UP)

    def _inverse(self, walls: Walls, face: Index, ray: Index, row: Index) -> Models:
        """Return u of faces or of the range: ``[N]``."""
        at_range = face == RANGE
        u = self._combine(walls.ratio(np.where(at_range, 0, face), row), ray)
        c = np.where(at_range, 0.0, u.c)
        c[0] = np.where(at_range, 1 / self._reach, c[0])
        return Models(c, np.where(at_range, U / self._reach, u.radius))

    def _kinks(self, walls: Walls, choice: Choice, slack: Array, allowed: Array) -> Guards:
        """Put small kinks into slack ``[rays, rows]``; return the others."""
        g = choice.nearer
        models = self._inverse(walls, g.first, g.ray, g.row) - self._inverse(
            walls, g.second, g.ray, g.row
        )
        fails = np.maximum(-bounds(models)[0], 0.0)
        small = fails <= allowed[g.row]
        # Where the wall met is entered later than face ``second`` says, it must not be left by
        # then: that would be a jump.
        for n in np.flatnonzero(small & (fails > 0) & (g.first != RANGE) & (g.second != RANGE)):
            small[n] = not self._may_leave(walls, g.first[n], g.second[n], g.ray[n], g.row[n])
        np.maximum.at(slack, (g.ray[small], g.row[small]), fails[small])
        large = np.flatnonzero(~small)
        return Guards(models[large], fails[large], g.row[large], (None,) * len(large))

    def _may_leave(self, walls: Walls, late: int, early: int, ray: int, row: int) -> bool:
        """Tell whether a ray may have left the wall of faces late and early before it enters late.

        Only through a face that the car may be inside of; False for faces of two walls.
        """
        wall = walls.faces[late].polygon
        if walls.faces[early].polygon != wall:
            return False
        for k, face in enumerate(walls.faces):
            if face.polygon != wall or k in {late, early} or walls.usable[k, row]:
                continue
            pair = (late, k) if late < k else (k, late)
            cross = walls.cross(np.array([walls.pairs.index(pair)]), np.array([row]))
            inside = self._combine(cross, np.array([ray])).times(1.0 if late < k else -1.0)
            if not bounds(inside)[0][0] >= 0:
                return True
        return False

    def _jumps(self, walls: Walls, choice: Choice) -> list[Guards]:
        g = choice.passes
        models = self._combine(walls.cross(g.pair, g.row), g.ray).times(g.sign)
        low = bounds(models)[0]
        fail = np.flatnonzero(~(low >= 0))  # NaN, from overflow, proves nothing
        decisions = []
        for n in fail:
            front, back = (walls.faces[i] for i in walls.pairs[g.pair[n]])
            decisions.append(
                Decision(front.polygon, front.place, back.place, int(g.ray[n]), bool(g.sign[n] > 0))
            )
        passes = Guards(models[fail], -low[fail], g.row[fail], tuple(decisions))
        r = choice.recedes
        models = -self._combine(walls.rate(r.face, r.row), r.ray)
        low = bounds(models)[0]
        fail = np.flatnonzero(~(low >= 0))
        return [passes, Guards(models[fail], -low[fail], r.row[fail], (None,) * len(fail))]

    def _distances(self, walls: Walls, choice: Choice, slack: Array) -> Models:
        rays, rows = choice.winner.shape
        ray, row = (x.ravel() for x in np.indices((rays, rows)))
        winner, slack = choice.winner.ravel(), slack.ravel()
        inverse = self._inverse(walls, winner, ray, row).widen(slack)
        distance = reciprocal(inverse)
        # At the range u may exceed 1 / range by the slack: the reading is at least this short.
        short = self._reach**2 * slack * UP
        at_range = winner == RANGE
        c = np.where(at_range, 0.0, distance.c)
        c[0] = np.where(at_range, self._reach, c[0])
        radius = np.where(at_range, short, distance.radius)
        return Models(c.reshape(-1, rays, rows), radius.reshape(rays, rows))


def _join(parts: list[Guards]) -> Guards:
    return Guards(
        Models(
            np.concatenate([p.models.c for p in parts], axis=-1),
            np.concatenate([p.models.radius for p in parts]),
        ),
        np.concatenate([p.fails for p in parts]),
        np.concatenate([p.row for p in parts]),
        tuple(d for p in parts for d in p.decisions),
    )

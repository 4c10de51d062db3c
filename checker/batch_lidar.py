"""The LiDAR of many rows and all rays at once, in doubles: see ``checker.lidar`` and ``batch``.

Only the plain case is proved here, which nearly all readings are: one face's model is the reading
on all of the row. The others are left to ``checker.lidar``.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from flint import arb
from numpy.typing import NDArray

from checker import balls, models
from checker.balls import Balls, above, add, exact, lower, multiply, subtract, upper
from checker.batch import (
    by_entry,
    cosine,
    inverse,
    joined,
    product,
    range_of,
    reciprocal,
    settled,
    sine,
)
from checker.lidar import NEAREST, Assumed, Face, Rays

#: Numbers in an array of readings; of more, arrays do not fit the caches.
_AT_ONCE = 1 << 18


def readings(
    rays: Rays, obstacles: list[list[list[float]]], states: Balls, assumed: Sequence[Assumed]
) -> tuple[Balls, NDArray]:
    """Return the readings ``[rows, rays, entries]`` (m), settled, and which are proved.

    obstacles: of a frame; states: settled models ``[rows, 4, entries]``; assumed: by each row.
    """
    rows, _, entries = states.middle.shape
    blocks = min(rays.count, -(-rays.count * rows * entries // _AT_ONCE))
    ends = [rays.count * k // blocks for k in range(blocks + 1)]
    out = exact(np.zeros((rows, rays.count, entries)))
    proved = np.zeros((rows, rays.count), dtype=bool)
    with np.errstate(all="ignore"):
        faces = _Faces(rays, obstacles, states, assumed)
        for part in map(slice, ends, ends[1:]):
            read, proved[:, part] = _Sight(faces, rays, part).readings()
            out.middle[:, part], out.radius[:, part] = read
    return out, proved


class _Faces:
    """What the cars of some rows see of a frame's faces, if each row assumes some signs.

    Arrays have the shape ``[rows, faces]``. A pair (cos p + sin q along a ray at an angle) is a
    model more, ``[..., 2, entries]``.
    """

    def __init__(
        self, rays: Rays, obstacles: list[list[list[float]]], states: Balls,
        assumed: Sequence[Assumed],
    ) -> None:  # fmt: skip
        self.faces: list[Face] = [(o, k) for o, x in enumerate(obstacles) for k in range(len(x))]
        self.of = [
            [i for i, (other, _) in enumerate(self.faces) if other == o]
            for o in range(len(obstacles))
        ]
        self._describe([face for x in obstacles for face in x], rays.reach, by_entry(states))
        self.given = self._take(assumed, rays.count)
        self._crosses: dict[tuple[int, int], Balls] = {}

    def _describe(self, faces: list[list[float]], reach: arb, states: Balls) -> None:
        """Note g and h of all faces, and u of distant ones: distances, rates, inverse distances."""
        s, f, theta = (states.at(slice(None), None, k) for k in (0, 1, 3))
        sin, cos = sine(theta), cosine(theta)
        a, b, c = (exact(column[:, None]) for column in np.array(faces, dtype=float).T)
        miss = add(multiply(a, s), multiply(b, f))
        first = subtract(miss.at(..., slice(0, 1)), c)
        self.miss = settled(joined([first, miss.at(..., slice(1, None))]))
        outside = range_of(self.miss)
        self.outside = lower(outside), upper(outside)
        limits = np.array([above(reach * models.length(face)) for face in faces])
        far = self.outside[0] > limits
        self.near = np.stack([~far[:, mine].any(axis=1) for mine in self.of], axis=1)
        near = np.stack([self.near[:, o] for o, _ in self.faces], axis=1)
        self.distant = near & (self.outside[0] > above(NEAREST))
        ahead = add(multiply(a, sin), multiply(b, cos))
        across = subtract(multiply(a, cos), multiply(b, sin))
        self.rates = settled(_stacked(ahead, across))
        over = reciprocal(self.miss)
        inverses = product(self.rates, over.at(slice(None), slice(None), None))
        self.inverses = {
            k: inverses.at(slice(None), k) for k in range(len(faces)) if self.distant[:, k].any()
        }

    def cross(self, j: int, k: int) -> Balls:
        """Return the pairs of X_jk."""
        if (j, k) not in self._crosses:
            one, other = self.rates.at(slice(None), k), self.rates.at(slice(None), j)
            g, f = (self.miss.at(slice(None), i, None) for i in (j, k))
            self._crosses[j, k] = settled(subtract(product(one, g), product(other, f)))
        return self._crosses[j, k]

    def _take(self, assumed: Sequence[Assumed], rays: int) -> dict[tuple[int, int], NDArray]:
        """Return the signs of X_jk, j < k, that rows assume."""
        found: dict[tuple[int, int], NDArray] = {}
        for row, signs in enumerate(assumed):
            for (ray, o, a, b), positive in signs.items():
                j, k = (self.of[o][i] for i in sorted((a, b)))
                if (j, k) not in found:
                    found[j, k] = np.zeros((len(assumed), rays), dtype=np.int8)
                found[j, k][row, ray] = 1 if positive == (a < b) else -1
        return found


class _Sight:
    """What rays next to each other see of the faces: quantities along rays, ``[rows, rays]``."""

    def __init__(self, faces: _Faces, rays: Rays, part: slice) -> None:
        self._faces, self._of, self._inverses = faces, faces.of, faces.inverses
        self._directions = rays.directions_in_doubles.at(part)
        self._reach, self._least = float(rays.reach), balls.from_arb([1 / rays.reach], (1,))
        self._shape = len(faces.near), len(self._directions.middle)
        self._given = {pair: signs[:, part] for pair, signs in faces.given.items()}
        self._signs: dict[tuple[int, int], tuple[NDArray, NDArray]] = {}

    # --- quantities along rays -------------------------------------------------------------

    def _products(self, pairs: Balls) -> tuple[NDArray, NDArray]:
        """Return a quantity's entries along all rays, ``[entries, rows, rays]``, and their errors.

        pairs: settled. The errors of all entries are in one sum: of the product of two terms, of
        the directions, and the rest.
        """
        directions, errors = self._directions
        reach, entries = np.abs(directions) + errors, pairs.middle.shape[-1]
        lost = (np.abs(pairs.middle).sum(-1) @ (errors + 4 * balls.U * reach).T) + (
            pairs.radius[..., -1] @ reach.T
        )
        z = np.moveaxis(pairs.middle, -1, 0) @ directions.T
        return z, lost * (1 + 2 * (entries + 8) * balls.U) * balls.UP + balls.TINY

    def _along(self, pairs: Balls) -> Balls:
        """Return models ``[rows, rays, entries]`` of a quantity along all rays, settled."""
        z, rest = self._products(pairs)
        radius = np.zeros_like(z)
        radius[-1] = rest
        return Balls(np.moveaxis(z, 0, -1), np.moveaxis(radius, 0, -1))

    def _middles(self, pairs: Balls) -> NDArray:
        """Return a quantity at the middle of rows; a guide, no proof."""
        return np.asarray(pairs.middle[..., 0] @ self._directions.middle.T)

    def _ranges(self, pairs: Balls) -> Balls:
        """Return balls with all values of a quantity along all rays: range_of(self._along(pairs)).

        With the errors of all entries in one sum.
        """
        z, lost = self._products(pairs)
        middle = z[0] + (z[2] + z[4]) / 2
        share = np.ones(len(z))  # of what an entry moves to both sides
        share[[0, 2, 4]] = 4 * balls.U, 0.5 + 4 * balls.U, 0.5 + 4 * balls.U  # x^2, x^4: [0, 1]
        stray = np.tensordot(share, np.abs(z, out=z), 1) + lost
        return Balls(middle, stray * (1 + 2 * (len(z) + 8) * balls.U) * balls.UP + balls.TINY)

    def _sign(self, j: int, k: int) -> tuple[NDArray, NDArray]:
        """Return 1 where X_jk >= 0 along rays is assumed or proved, -1 where < 0, 0 where open.

        The second array is a guess of X_jk that has the assumed signs.
        """
        if (j, k) not in self._signs:
            a, b = min(j, k), max(j, k)
            pairs, sure = self._faces.cross(a, b), self._given.get((a, b), np.zeros((), dtype=int))
            values, guess = self._ranges(pairs), np.where(sure != 0, sure, self._middles(pairs))
            low, high = lower(values), upper(values)
            signs = np.where(low >= 0, 1, np.where(high < 0, -1, 0))
            turned = np.where(high <= 0, 1, np.where(low > 0, -1, 0))
            self._signs[a, b] = np.where(sure != 0, sure, signs), guess
            self._signs[b, a] = np.where(sure != 0, -sure, turned), -guess
        return self._signs[j, k]

    # --- readings --------------------------------------------------------------------------

    def readings(self) -> tuple[Balls, NDArray]:
        """Return the readings, settled, and which are proved."""
        winner = self._winners()
        u, proved = self._met(winner)
        for o, mine in enumerate(self._of):
            asked = self._faces.near[:, o, None] & ~np.isin(winner, mine)
            proved &= ~asked | self._behind(winner, mine, asked)
        read = inverse(u)
        nothing = winner < 0
        read.middle[nothing], read.radius[nothing] = 0, 0
        read.middle[nothing, 0] = self._reach
        return read, proved & np.isfinite(read.middle + read.radius).all(axis=-1)

    def _winners(self) -> NDArray:
        """Return the face that each ray meets from the middle of each row, or -1; a guess."""
        best, winner = np.full(self._shape, self._least.middle), np.full(self._shape, -1)
        for mine in self._of:
            for j in filter(self._inverses.__contains__, mine):
                guess = self._middles(self._inverses[j])
                nearer = self._faces.distant[:, j, None] & (guess > best)
                for k in mine:
                    if k != j:
                        nearer &= self._sign(j, k)[1] >= 0
                best, winner = np.where(nearer, guess, best), np.where(nearer, j, winner)
        return winner

    def _met(self, winner: NDArray) -> tuple[Balls, NDArray]:
        """Return 1 / reading if nothing else is hit before, and whether the winner surely is."""
        entries = self._faces.miss.middle.shape[-1]
        u = by_entry(exact(np.zeros((*self._shape, entries))))
        u.middle[..., 0], u.radius[..., -1] = self._least
        proved = np.ones(self._shape, dtype=bool)
        for j, pairs in self._inverses.items():
            mine = winner == j
            if not mine.any():
                continue
            for whole, part in zip(u, self._along(pairs), strict=True):
                np.copyto(whole, part, where=mine[..., None])
            proved &= ~mine | (lower(self._ranges(pairs)) >= upper(self._least))
            for k in self._of[self._faces.faces[j][0]]:
                if k != j:
                    proved &= ~mine | (self._sign(j, k)[0] > 0)
        return u, proved

    def _behind(self, winner: NDArray, faces: list[int], asked: NDArray) -> NDArray:
        """Tell where an obstacle is missed, or hit no nearer than the winner or the range."""
        found = np.zeros(self._shape, dtype=bool)
        for k in filter(self._inverses.__contains__, faces):
            v, open_ = self._inverses[k], asked & self._faces.distant[:, k, None]
            if (open_ & (winner < 0)).any():
                beyond = upper(self._ranges(v)) <= lower(self._least)
                found |= open_ & (winner < 0) & beyond
            for j, u in self._inverses.items():
                mine = open_ & (winner == j) & ~found
                if mine.any():
                    found |= mine & (upper(self._ranges(settled(subtract(v, u)))) <= 0)
        if (asked & ~found).any():
            found |= self._passes(faces)
        return found

    def _passes(self, faces: list[int]) -> NDArray:
        """Tell where rays surely miss an obstacle: see ``checker.lidar.View._passes``."""
        outside, within = self._faces.outside[0] > 0, self._faces.outside[1] <= 0
        leaves = {k: upper(self._ranges(self._faces.rates.at(slice(None), k))) <= 0 for k in faces}
        found = np.zeros(self._shape, dtype=bool)
        for j in faces:
            found |= outside[:, j, None] & leaves[j]
        for j, k in permutations(faces, 2):
            beyond = within[:, k, None] | leaves[k]
            found |= outside[:, j, None] & beyond & (self._sign(j, k)[0] < 0)
        return found


def without(scans: Balls, gone: Sequence[int], reach: float) -> Balls:
    """Return scans ``[..., rays, entries]`` with rays missing, which read the reach."""
    middle, radius = scans.middle.copy(), scans.radius.copy()
    middle[..., gone, :], radius[..., gone, :] = 0, 0
    middle[..., gone, 0] = reach
    return Balls(middle, radius)


def followed(scans: Balls, gone: Sequence[int], reach: float, noise: float) -> Balls:
    """Return scans with noise and rest of each reading as a symbol more, but of missing rays.

    As ``checker.step.Sensors.readings``.
    """
    *shape, n, entries = scans.middle.shape
    m = (entries - models.TERMS - 1) // 2
    first = models.TERMS + m
    there = np.ones(n, dtype=bool)
    there[gone] = False
    own = np.where(there, (scans.radius[..., -1] + noise) * balls.UP + balls.TINY, 0.0)
    middle = np.zeros((*shape, n, entries + 2 * n))
    middle[..., :first] = scans.middle[..., :first]
    middle[..., first + n : first + n + m] = scans.middle[..., first:-1]
    values = range_of(scans)
    # Cut off at the reach.
    cut = there & ~scans.middle[..., 1:].any(axis=-1) & ~(upper(values) < reach)
    low = lower(subtract(exact(lower(values)), exact(np.array(noise))))
    ball = balls.between(low, np.full_like(low, reach))
    middle[cut, 0], own[cut] = ball.middle[cut], ball.radius[cut]
    middle[..., np.arange(n), first + np.arange(n)] = own
    return exact(middle)


def _stacked(first: Balls, second: Balls) -> Balls:
    return Balls(*(np.stack(pair, axis=-2) for pair in zip(first, second, strict=True)))

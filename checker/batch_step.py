"""One control period of many rows at once, in doubles: see ``checker.step`` and ``batch``.

Only the plain case is proved here: a car without slip, and a clearance that single faces show. The
others are left to ``checker.step``.
"""

from __future__ import annotations

from math import comb, factorial

import numpy as np
from flint import arb
from numpy.typing import NDArray

from checker import balls, models
from checker.balls import (
    Balls,
    above,
    add,
    around,
    exact,
    lower,
    multiply,
    raised,
    size,
    subtract,
    times,
)
from checker.batch import (
    apply,
    cosine,
    product,
    range_of,
    riccati,
    scaled,
    settled,
    sine,
)
from checker.step import Motion

#: Models of s and f.
Point = tuple[Balls, Balls]
#: A share of an arc that is not halved once more to show its clearance.
_SHORTEST = 2.0**-6


class Arcs:
    """The arcs that some rows drive in one period; all models settled, ``[rows, entries]``.

    states: ``[rows, 4, entries]``; steering (rad): of one symbol more, which ``end`` has, too.
    """

    def __init__(self, motion: Motion, states: Balls, steering: Balls) -> None:
        if motion.slip:
            raise ValueError("arcs of cars that slip are not known in doubles")
        s, f, speed, self._theta = (_longer(states.at(slice(None), k)) for k in range(4))
        curvature = settled(multiply(_tan(steering), _number(1 / motion.base)))
        self._distance = settled(scaled(speed, *map(_number, (motion.gone, motion.pushed))))
        after = settled(scaled(speed, *map(_number, (motion.decay, motion.gained))))
        self._turned = product(curvature, self._distance)
        self._first = s, f
        self._last = self.point(1.0, np.arange(len(states.middle)))
        ends = zip(*self._last, after, settled(add(self._theta, self._turned)), strict=True)
        self.end = Balls(*(np.stack(z, axis=1) for z in ends))
        bend, far = size(range_of(curvature)), size(range_of(self._distance))
        #: At least curvature length^2 / 8: by so much an arc may leave its chord.
        self._bulge = raised(raised(bend * far) * far / 8)

    def point(self, share: float, rows: NDArray) -> Point:
        """Return s and f of some rows after a share of the arc, a power of 2 or a sum of such."""
        s, f, theta, distance, turned = (
            z.at(rows) for z in (*self._first, self._theta, self._distance, self._turned)
        )
        half = settled(times(turned, share / 2))
        chord = product(settled(times(distance, share)), _sinc(half))
        course = settled(add(theta, half))
        s = settled(subtract(s, product(chord, sine(course))))
        return s, settled(subtract(f, product(chord, cosine(course))))

    def clear(self, polygon: list[list[float]], margin: float) -> NDArray:
        """Tell which arcs surely miss a polygon by ``margin``, one face showing it on each piece.

        As ``checker.step.Path.clear``, without means of faces.
        """
        every = np.arange(len(self._bulge))
        return self._clear(polygon, margin, every, (0.0, 1.0), (self._first, self._last))

    def _clear(
        self, polygon: list[list[float]], margin: float, rows: NDArray,
        shares: tuple[float, float], ends: tuple[Point, Point],
    ) -> NDArray:  # fmt: skip
        """Tell the same of a piece of some rows' arcs, between two shares and points of it."""
        start, end = shares
        found = np.zeros(len(rows), dtype=bool)
        for face in polygon:
            bulge = raised(self._bulge[rows] * (end - start) ** 2 * above(models.length(face)))
            low = np.minimum(*(_least_miss(face, *place) for place in ends))
            found |= lower(subtract(exact(low), exact(bulge))) >= margin
        if found.all() or end - start < _SHORTEST:
            return found
        open_, middle = np.flatnonzero(~found), (start + end) / 2
        rows, point = rows[open_], self.point(middle, rows[open_])
        first, last = ((s.at(open_), f.at(open_)) for s, f in ends)
        clear = self._clear(polygon, margin, rows, (start, middle), (first, point))
        if clear.any():
            clear &= self._clear(polygon, margin, rows, (middle, end), (point, last))
        found[open_] = clear
        return found


def _least_miss(face: list[float], s: Balls, f: Balls) -> NDArray:
    """Return lower bounds of a s + b f - c of a face (a, b, c)."""
    a, b, c = (exact(np.array([value], dtype=float)) for value in face)
    return lower(subtract(range_of(settled(add(multiply(a, s), multiply(b, f)))), c))


def _number(value: arb) -> Balls:
    return balls.from_arb([value], (1,))


def _longer(z: Balls) -> Balls:
    """Return models with one symbol more, the last, that they do not move with."""
    entries = z.middle.shape[-1]
    m = (entries - models.TERMS - 1) // 2
    places = [entries - 1 - m, entries - 1]
    return Balls(*(np.insert(x, places, 0.0, axis=-1) for x in z))


def _tan_taylor(y: Balls, n: int) -> list[Balls]:
    pairs = zip(y.middle.flat, y.radius.flat, strict=True)
    values = [arb(middle, radius).tan() for middle, radius in pairs]
    return riccati([balls.from_arb(values, y.middle.shape)], 1, n)


def _tan(z: Balls) -> Balls:
    """Return the tangents, settled; not finite where z may be a right angle."""
    return settled(apply(z, _tan_taylor))


def _sinc_taylor(y: Balls, n: int) -> list[Balls]:
    """Return the Taylor coefficients of the polynomial of degree 10."""
    square, out = multiply(y, y), []
    for k in range(n + 1):
        even = range(k + k % 2, 12, 2)
        total = exact(np.zeros_like(y.middle))
        for j in reversed(even):
            term = balls.over(exact(np.array(comb(j, k) * (-1.0) ** (j // 2))), factorial(j + 1))
            total = add(multiply(total, square), term)
        out.append(multiply(total, y) if k % 2 else total)
    return out


def _sinc(z: Balls) -> Balls:
    """Return sin(z) / z, settled; not finite where |z| may be larger than 1."""
    most = size(range_of(z))
    # The series alternates with falling terms. Twice: more than rounding can take from it.
    cut = np.where(most <= 1, 2 * most**12 / factorial(13), np.inf)
    out = settled(apply(z, _sinc_taylor))
    more = around(np.zeros_like(out.radius))
    more.radius[..., -1] = cut
    return settled(add(out, more))

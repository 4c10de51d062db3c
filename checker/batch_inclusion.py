"""Whether rows contain images, for many at once, in doubles: see ``checker.inclusion``."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from checker import balls
from checker.balls import Balls, add, exact, lower, multiply, size, subtract, times, upper
from checker.batch import parts, upper_sum
from checker.files import Row
from checker.models import TERMS


def hold_images(images: Balls, rows: Sequence[Row], carried: int) -> NDArray:
    """Tell which rows surely contain their images: what ``prove_image`` proves.

    images: settled models ``[rows, 4, entries]``.
    """
    centre, spread = np.array([x.centre for x in rows]), np.array([x.spread for x in rows])
    radius = np.array([x.radius for x in rows])
    d = _less(images, centre, spread[..., :carried, :])
    a, b = spread[..., carried:, 0], spread[..., carried:, 1]
    # A column without a constant part is not used: its e' is 0.
    b = np.where((a != 0).any(axis=1)[:, None], b, 0.0)
    w = _inverse(a)
    slopes = np.einsum("nki,nik->nk", w, b)
    left = size(_times(_one_less(a, w), d))
    turned = size(subtract(multiply(exact(slopes[:, None]), exact(a)), exact(b)))
    used = upper_sum([left, turned])
    room = lower(subtract(exact(radius), exact(used)))
    # What room the radius leaves takes up a part of d's rest.
    rest = np.maximum(upper(subtract(exact(d.radius[..., -1]), exact(room))), 0)
    d.radius[..., -1] = rest
    within = _within(balls.product(w, d), slopes)
    return np.asarray((room >= 0).all(axis=1) & within.all(axis=1))


def _less(images: Balls, centre: NDArray, carried: NDArray) -> Balls:
    """Return the images less the rows' polynomials in x and the symbols that are the same."""
    other, same = np.zeros_like(images.middle), carried.shape[2]
    m = (other.shape[-1] - TERMS - 1) // 2
    other[..., :TERMS] = centre
    for k in range(2):
        first = TERMS + k * m
        other[..., first : first + same] = carried[..., k]
    return subtract(images, exact(other))


def _inverse(a: NDArray) -> NDArray:
    """Return matrices near the (pseudo)inverses; any will do."""
    sizes = np.abs(a).sum(axis=1)
    there = sizes > balls.TINY  # whose reciprocals are finite
    scale = np.where(there, 1 / np.where(there, sizes, 1), 0)
    return np.asarray(scale[..., None] * np.linalg.pinv(a * scale[:, None], rcond=1e-13))


def _one_less(a: NDArray, w: NDArray) -> Balls:
    """Return 1 - a w."""
    return subtract(exact(np.eye(4)), balls.product(a, exact(w)))


def _times(matrix: Balls, d: Balls) -> Balls:
    """Return a product with a matrix that is known in balls."""
    z, more = balls.product(matrix.middle, d), matrix.radius @ size(d)
    return Balls(z.middle, (z.radius + more) * balls.UP + balls.TINY)


def _within(y: Balls, slopes: NDArray) -> NDArray:
    """Tell where |y_k| <= 1 + s_k x for all x: at both ends, as bounds of |y_k| are convex."""
    p, a, b, rest = parts(y)
    # The rest of products with exact matrices is not settled: its middle is 0 all the same.
    odd = [size(p[k])[..., None] for k in (3, 5)]
    found = np.ones(slopes.shape, dtype=bool)
    for x, sign in product((-1.0, 1.0), (-1.0, 1.0)):
        middle = times(add(p[0], times(p[1], x)), sign)
        even = [np.maximum(upper(times(p[k], sign)), 0)[..., None] for k in (2, 4)]
        stray = upper_sum([size(add(a, times(b, x))), rest[..., None], *odd, *even])
        most = add(middle, exact(stray))
        found &= upper(most) <= lower(add(exact(np.ones_like(slopes)), exact(slopes * x)))
    return found

"""Members of Taylor models, evaluated with Arb at 200 bits, and whether a result holds them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from verifier.arithmetic import BASE, KNOWN, PAIRS
from verifier.models import TERMS, Models

flint = pytest.importorskip("flint", reason="python-flint evaluates functions exactly")
flint.ctx.prec = 200
arb = flint.arb

#: Far above the rounding of the sums here, relative; far below that of doubles.
OWN_ROUNDING = arb(2) ** -150


@dataclass(frozen=True)
class Place:
    """A start position x and values of the error symbols, in [-1, 1] all."""

    x: float
    e: np.ndarray


def places(random: np.random.Generator, symbols: int) -> list[Place]:
    """Return both ends and places between, errors at extreme signs first.

    Products of symbols are what they have to be, exactly.
    """
    found = [Place(x, random.choice([-1.0, 1.0], symbols)) for x in (-1.0, 1.0, 0.0)]
    found += [
        Place(random.uniform(-1, 1), random.choice([-1.0, 1.0, 0.0, 0.25], symbols))
        for _ in range(3)
    ]
    if symbols >= KNOWN:
        for place in found:
            place.e[BASE:KNOWN] = products(place.e)
    return found


def products(e: Sequence) -> list:
    """Return 2 e_i^2 - 1 and e_i e_j of the first symbols."""
    return [2 * e[i] * e[i] - 1 if i == j else e[i] * e[j] for i, j in PAIRS]


def polynomial(models: Models, index: tuple[int, ...], place: Place) -> arb:
    """Return the polynomial and the error symbols of one model at a place."""
    total, power = arb(0), arb(1)
    for k in range(TERMS):
        total += arb(float(models.c[(k, *index)])) * power
        power *= arb(place.x)
    for j, e in enumerate(place.e):
        constant, slope = (float(models.c[(TERMS + 2 * j + n, *index)]) for n in (0, 1))
        total += (arb(constant) + arb(slope) * arb(place.x)) * arb(float(e))
    return total


def member(models: Models, index: tuple[int, ...], place: Place, rest: float = 0.0) -> arb:
    """Return a member: rest, in [-1, 1], is its place in the radius."""
    return polynomial(models, index, place) + arb(float(models.radius[index])) * arb(rest)


def excess(models: Models, index: tuple[int, ...], place: Place, value: arb) -> float:
    """Return by what multiple of the radius a value is off: above 1 the models do not hold it."""
    radius = float(models.radius[index])
    middle = polynomial(models, index, place)
    # Arb's own rounding is beside the point, and matters where the radius is 0.
    off = max(abs(value - middle).upper() - OWN_ROUNDING * (abs(value) + abs(middle)), arb(0))
    if not np.isfinite(radius):
        return 0.0 if radius > 0 else np.inf
    if off <= arb(radius):
        return float(off / arb(radius)) if radius else 0.0
    return max(float(off / arb(radius)) if radius else np.inf, 1 + 1e-9)


def worst_excess(
    arguments: Sequence[Models],
    result: Models,
    exact: Callable[..., arb],
    random: np.random.Generator,
) -> float:
    """Return the largest excess over members of one-dimensional batches of rows."""
    worst = 0.0
    for row in range(result.radius.shape[-1]):
        for place in places(random, result.symbols):
            rests = random.choice([-1.0, 1.0, 0.0], len(arguments))
            values = [
                member(a, (row,), place, rest) for a, rest in zip(arguments, rests, strict=True)
            ]
            worst = max(worst, excess(result, (row,), place, exact(*values)))
    return worst


def random_models(
    random: np.random.Generator,
    shape: tuple[int, ...],
    width: float,
    symbols: int = 3,
    error: float = 0.0,
    centre: float = 1.0,
) -> Models:
    """Return models that stray by about ``width`` from centres of about ``centre``.

    error: size of the symbols' part and of the radius.
    """
    c = np.zeros((TERMS + 2 * symbols, *shape))
    falling = (width * 0.5 ** np.arange(TERMS - 1)).reshape(-1, *[1] * len(shape))
    c[0] = centre * random.normal(size=shape)
    c[1:TERMS] = falling * random.normal(size=(TERMS - 1, *shape))
    c[TERMS:] = error * random.normal(size=(2 * symbols, *shape))
    radius = error * random.random(shape) * random.integers(0, 2, shape)
    return Models(c, radius)

"""Taylor models: polynomials in the start position, error symbols, and a remainder.

A batch of models over one set of rows is the set of all

    sum_k c[k] x^k  +  sum_j (c[D + 2 j] + c[D + 2 j + 1] x) e_j  +  rest,   |rest| <= radius

for the same x in [-1, 1] and e in [-1, 1]^m in all models of a row (D = DEGREE + 1). The x of
a row is its start position, scaled; the e are what earlier steps could not keep exactly.

Every operation returns models that contain the exact result for all members of its
arguments: what is cut off, and every rounding of its own, goes into the radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from verifier.rounding import TINY, UP, U, gamma

Array = NDArray[np.float64]

DEGREE = 5
TERMS = DEGREE + 1


@dataclass(frozen=True, eq=False)
class Models:
    """A batch of Taylor models; c: ``[TERMS + 2 m, ..., rows]``, radius: ``[..., rows]``."""

    c: Array
    radius: Array

    @property
    def symbols(self) -> int:
        """The number m of error symbols."""
        return (len(self.c) - TERMS) // 2

    def __getitem__(self, index: object) -> Models:
        """Index the batch (never the coefficients)."""
        full = index if isinstance(index, tuple) else (index,)
        return Models(self.c[(slice(None), *full)], self.radius[full])

    def __neg__(self) -> Models:
        return Models(-self.c, self.radius)

    def __add__(self, other: Models) -> Models:
        c = self.c + other.c
        return Models(c, (self.radius + other.radius + U * norm(c)) * UP)

    def __sub__(self, other: Models) -> Models:
        return self + (-other)

    def plus(self, constant: Array | float) -> Models:
        """Add real numbers that are given exactly."""
        c = self.c.copy()
        c[0] += constant
        return Models(c, (self.radius + U * np.abs(c[0])) * UP)

    def times(self, factor: Array | float) -> Models:
        """Multiply by real numbers that are given exactly."""
        c = self.c * factor
        return Models(c, (self.radius * np.abs(factor) + U * norm(c)) * UP + TINY)

    def widen(self, amount: Array | float) -> Models:
        """Add an unknown of at most ``amount`` (>= 0)."""
        return Models(self.c, (self.radius + amount) * UP)

    def __mul__(self, other: Models) -> Models:
        return multiply(self, other)


def norm(c: Array) -> Array:
    """Return the sum of the absolute values of all coefficients: ``[...]`` (not rounded up)."""
    return np.abs(c).sum(axis=0)


def constant(value: Array, symbols: int) -> Models:
    """Return models of known real numbers, ``[..., rows]``."""
    c = np.zeros((TERMS + 2 * symbols, *np.shape(value)))
    c[0] = value
    return Models(c, np.zeros(np.shape(value)))


def spread(models: Models) -> Array:
    """Return an upper bound of all but the constant coefficient: how far values stray from it."""
    return (norm(models.c[1:]) + models.radius) * UP


def error_spread(models: Models) -> Array:
    """Return an upper bound of the error symbols' part and the radius."""
    return (norm(models.c[TERMS:]) + models.radius) * UP


def bounds(models: Models) -> tuple[Array, Array]:
    """Return lower and upper bounds of all members, ``[..., rows]``.

    Even powers lie in [0, 1], which makes this tighter than the sum of absolute values.
    """
    c = models.c
    odd, even = np.abs(c[1:TERMS:2]).sum(axis=0), c[2:TERMS:2]
    rest = (odd + error_spread(models) + TERMS * U * (np.abs(c[0]) + norm(even) + odd)) * UP
    low = c[0] + np.minimum(even, 0).sum(axis=0) - rest
    high = c[0] + np.maximum(even, 0).sum(axis=0) + rest
    # The last two sums round once more each.
    slack = 4 * U * (np.abs(low) + np.abs(high))
    return low - slack, high + slack


def multiply(a: Models, b: Models) -> Models:
    """Return the product."""
    pa, pb, ea, eb = a.c[:TERMS], b.c[:TERMS], a.c[TERMS:], b.c[TERMS:]
    shape = np.broadcast_shapes(pa.shape[1:], pb.shape[1:])
    c = np.zeros((max(len(a.c), len(b.c)), *shape))
    for i in range(TERMS):
        c[i:TERMS] += pa[i] * pb[: TERMS - i]
    abs_a, abs_b = np.abs(pa), np.abs(pb)
    cut = np.zeros(shape)
    for i in range(1, TERMS):
        cut += abs_a[i] * abs_b[TERMS - i :].sum(axis=0)
    size_ea, size_eb = np.abs(ea).sum(axis=0), np.abs(eb).sum(axis=0)
    if len(eb):
        c[TERMS:] += pa[0] * eb
        c[TERMS + 1 :: 2] += pa[1] * eb[::2]
        cut += abs_a[1] * np.abs(eb[1::2]).sum(axis=0) + abs_a[2:].sum(axis=0) * size_eb
    if len(ea):
        c[TERMS:] += pb[0] * ea
        c[TERMS + 1 :: 2] += pb[1] * ea[::2]
        cut += abs_b[1] * np.abs(ea[1::2]).sum(axis=0) + abs_b[2:].sum(axis=0) * size_ea
    size_a, size_b = abs_a.sum(axis=0) + size_ea, abs_b.sum(axis=0) + size_eb
    radius = cut + size_ea * size_eb + a.radius * (size_b + b.radius) + b.radius * size_a
    # A coefficient is a sum of at most TERMS + 4 products.
    radius = radius + gamma(TERMS + 5) * size_a * size_b
    return Models(c, radius * UP + TINY)


def linear(weights: Array, absolute: Array, models: Models) -> Models:
    """Return ``weights @ models`` along the first batch axis.

    weights, absolute (its absolute values): ``[out, in]``; models: ``[in, rows]``. BLAS may
    sum in any order: an inner product of length n errs by gamma(n) times the inner product
    of absolute values.
    """
    c = np.matmul(weights, models.c)
    rounding = gamma(weights.shape[1] + 1)
    noise = models.radius + rounding * norm(models.c)
    # The sum of radii rounds as well, by rounding times itself at most.
    return Models(c, np.matmul(absolute, noise) * (1 + 2 * rounding) * UP * UP + TINY)


def stack(models: Sequence[Models]) -> Models:
    """Stack models along a new first batch axis."""
    return Models(np.stack([m.c for m in models], axis=1), np.stack([m.radius for m in models]))

"""Taylor models: polynomials in the start position, error symbols, and a remainder.

A batch of models over one set of rows is the set of all

    sum_k c[k] x^k  +  sum_j (c[D + 2 j] + c[D + 2 j + 1] x) e_j  +  rest,   |rest| <= radius

for the same x in [-1, 1] and e in [-1, 1]^m in all models of a row (D = DEGREE + 1). The x of
a row is its start position, scaled; the e are what earlier steps could not keep exactly.

Every operation returns models that contain the exact result for all members of its
arguments (verifier.arithmetic says how).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any

import numpy as np
from numpy.typing import NDArray

from verifier import arithmetic
from verifier.arithmetic import BASE, DEGREE, KNOWN, TERMS, Model
from verifier.compiled.kernel import kernel
from verifier.compiled.trace import Trace, Value
from verifier.rounding import TINY, UP, gamma

__all__ = ["DEGREE", "TERMS", "Array", "Models"]

Array = NDArray[np.float64]


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
        last, c, radius = full[-1], self.c, self.radius
        plain = all(isinstance(i, slice | int) for i in full[:-1]) and radius.ndim == len(full)
        if plain and isinstance(last, np.ndarray) and last.ndim == 1:
            # Rows: NumPy would put their axis first in memory; kernels want it last.
            c, radius = c[(slice(None), *full[:-1])], radius[full[:-1]]
            if last.dtype == bool:
                last = np.flatnonzero(last)
            if len(last) == radius.shape[-1] and (last == np.arange(len(last))).all():
                return Models(c, radius)
            return Models(np.take(c, last, axis=-1), np.take(radius, last, axis=-1))
        return Models(c[(slice(None), *full)], radius[full])

    def __neg__(self) -> Models:
        return Models(-self.c, self.radius)

    def __add__(self, other: Models) -> Models:
        return apply(Model.__add__, self, other)

    def __sub__(self, other: Models) -> Models:
        return apply(Model.__sub__, self, other)

    def plus(self, constant: Array | float) -> Models:
        """Add real numbers that are given exactly."""
        return apply(Model.plus, self, constant)

    def times(self, factor: Array | float) -> Models:
        """Multiply by real numbers that are given exactly."""
        return apply(Model.times, self, factor)

    def widen(self, amount: Array | float) -> Models:
        """Add an unknown of at most ``amount`` (>= 0)."""
        return apply(Model.widen, self, amount)

    def __mul__(self, other: Models) -> Models:
        return apply(arithmetic.multiply, self, other)


def apply(function: Callable, *arguments: Models | Array | float) -> Any:
    """Return a function of traced models and numbers, for batches of them.

    Batches are broadcast; the results are Models or arrays, in a tuple if there are several.
    """
    shape = _shape(arguments[0])
    if not all(isinstance(a, float | int) or _shape(a) == shape for a in arguments):
        shape = np.broadcast_shapes(*[_shape(a) for a in arguments])
        arguments = tuple(_broadcast(a, shape) for a in arguments)
    places = math.prod(shape)
    sizes, tables = [], []
    for argument in arguments:
        if isinstance(argument, Models):
            sizes.append(argument.symbols)
            tables.append(argument.c.reshape(len(argument.c), places))
            tables.append(argument.radius.reshape(1, places))
        else:
            sizes.append(-1)
            number = isinstance(argument, float | int)
            values = np.full(places, argument) if number else np.asarray(argument)
            tables.append(values.astype(float, copy=False).reshape(1, places))
    program = _pointwise(function, *sizes)
    out = program(places, tables)
    results, at = [], 0
    for symbols in program.shapes:
        if symbols < 0:
            results.append(out[at].reshape(shape))
            at += 1
        else:
            width = TERMS + 2 * symbols
            c = out[at : at + width].reshape(width, *shape)
            results.append(Models(c, out[at + width].reshape(shape)))
            at += width + 1
    return results[0] if len(results) == 1 else tuple(results)


def _shape(argument: Models | Array | float) -> tuple[int, ...]:
    return argument.radius.shape if isinstance(argument, Models) else np.shape(argument)


def _broadcast(argument: Models | Array | float, shape: tuple[int, ...]) -> Models | Array:
    if not isinstance(argument, Models):
        return np.broadcast_to(np.asarray(argument, dtype=float), shape)
    width, own = len(argument.c), argument.radius.shape
    c = argument.c.reshape(width, *[1] * (len(shape) - len(own)), *own)
    return Models(np.broadcast_to(c, (width, *shape)), np.broadcast_to(argument.radius, shape))


@kernel
def _pointwise(
    trace: Trace, function: Callable, *sizes: int
) -> tuple[list[Value], tuple[int, ...]]:
    """A kernel of ``function``; sizes: symbols of an argument, -1 for a number."""
    arguments = [trace.column() if n < 0 else arithmetic.read(trace, n) for n in sizes]
    results = function(*arguments)
    values, shapes = [], []
    for result in results if isinstance(results, tuple) else (results,):
        if isinstance(result, Model):
            values += result.values
            shapes.append((len(result.c) - TERMS) // 2)
        else:
            values.append(result)
            shapes.append(-1)
    return values, tuple(shapes)


def lifted(function: Callable) -> Callable[..., Any]:
    """Let a function of traced models and numbers also take batches of them."""

    @wraps(function)
    def call(*arguments: Any) -> Any:
        if any(isinstance(a, Model | Value) for a in arguments):
            return function(*arguments)
        return apply(function, *arguments)

    return call


def norm(c: Array) -> Array:
    """Return the sum of the absolute values of all coefficients: ``[...]`` (not rounded up)."""
    return np.abs(c).sum(axis=0)


def cuttable(symbols: int) -> list[int]:
    """Return which of so many symbols are no products: rows can be divided along those."""
    return [j for j in range(symbols) if symbols < KNOWN or not BASE <= j < KNOWN]


def constant(value: Array, symbols: int) -> Models:
    """Return models of known real numbers, ``[..., rows]``."""
    c = np.zeros((TERMS + 2 * symbols, *np.shape(value)))
    c[0] = value
    return Models(c, np.zeros(np.shape(value)))


#: The functions of verifier.arithmetic, for batches.
spread = lifted(arithmetic.spread)
error_spread = lifted(arithmetic.error_spread)
bounds = lifted(arithmetic.bounds)
multiply = lifted(arithmetic.multiply)
substitute = lifted(arithmetic.substitute)


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


def padded(models: Models, symbols: int) -> Models:
    """Return the models with at least so many error symbols, the new ones 0."""
    if models.symbols >= symbols:
        return models
    c = np.zeros((TERMS + 2 * symbols, *models.c.shape[1:]))
    c[: len(models.c)] = models.c
    return Models(c, models.radius)

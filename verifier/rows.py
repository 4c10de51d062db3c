"""Rows: pieces of the start range and models of the state on each.

The state is (s, f, v, theta) as Taylor models over one piece. To split a piece, or to keep
only the part of it where a wall decision can go one way, is to substitute
x = middle + half * x' into all of its models.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from verifier.models import TERMS, Array, Models, error_spread, norm
from verifier.rounding import TINY, UP, gamma

S, F, V, THETA = range(4)


@dataclass(frozen=True)
class Decision:
    """An assumption about one ray in the current step.

    positive: the sign of the cross product X of faces ``front`` and ``back`` of an obstacle,
    seen along the ray (verifier.walls). Its other sign is another row's business.
    """

    polygon: int
    front: int
    back: int
    ray: int
    positive: bool


@dataclass(frozen=True, eq=False)
class Rows:
    """A batch of rows.

    state: models ``[4, rows]`` of s, f, v, theta; frame: ``[rows]``; low, high: ``[rows]``,
    the piece in the units of the start range, -1 to 1 (exact bounds of it live in the
    models; these serve to report and to find witnesses); least: ``[rows]``, proved lower
    bound of the margin so far (m); decisions: per row, assumptions for the current step;
    kink: ``[rows]``, kinks of up to this (1/m) go into the radius in the current step;
    tried: ``[rows]``, the error of the current step on a wider piece (inf at first).
    """

    state: Models
    frame: NDArray[np.intp]
    low: Array
    high: Array
    least: Array
    decisions: tuple[tuple[Decision, ...], ...]
    kink: Array
    tried: Array

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, index: NDArray) -> Rows:
        """Return the rows at ``index`` (integers or booleans)."""
        index = np.flatnonzero(index) if index.dtype == bool else index
        return Rows(
            self.state[:, index],
            self.frame[index],
            self.low[index],
            self.high[index],
            self.least[index],
            tuple(self.decisions[i] for i in index),
            self.kink[index],
            self.tried[index],
        )

    def restrict(self, low: Array, high: Array) -> Rows:
        """Return the rows on the parts [low, high] (within [-1, 1]) of their pieces.

        The new models cover at least that part.
        """
        middle = (low + high) / 2
        # Rounded up, so that the new [-1, 1] covers [low, high].
        half = (high - low) / 2 * UP + 2.0**-50
        width = (self.high - self.low) / 2
        centre = (self.high + self.low) / 2
        return replace(
            self,
            state=substitute(self.state, middle, half),
            low=centre + width * low,
            high=centre + width * high,
        )


def join(parts: list[Rows]) -> Rows:
    """Join batches of rows."""
    return Rows(
        state=Models(
            np.concatenate([p.state.c for p in parts], axis=-1),
            np.concatenate([p.state.radius for p in parts], axis=-1),
        ),
        frame=np.concatenate([p.frame for p in parts]),
        low=np.concatenate([p.low for p in parts]),
        high=np.concatenate([p.high for p in parts]),
        least=np.concatenate([p.least for p in parts]),
        decisions=tuple(d for p in parts for d in p.decisions),
        kink=np.concatenate([p.kink for p in parts]),
        tried=np.concatenate([p.tried for p in parts]),
    )


def substitute(models: Models, middle: Array, half: Array) -> Models:
    """Return the models in x' where x = middle + half x' (both ``[rows]``, exact)."""
    c = models.c
    out = np.zeros_like(c)
    powers_m, powers_h = [np.ones_like(middle)], [np.ones_like(half)]
    for _ in range(1, TERMS):
        powers_m.append(powers_m[-1] * middle)
        powers_h.append(powers_h[-1] * half)
    for i in range(TERMS):
        for j in range(i, TERMS):
            out[i] += comb(j, i) * (c[j] * (powers_m[j - i] * powers_h[i]))
    out[TERMS::2] = c[TERMS::2] + c[TERMS + 1 :: 2] * middle
    out[TERMS + 1 :: 2] = c[TERMS + 1 :: 2] * half
    # |middle| + half <= 1 up to rounding, so no intermediate result exceeds 2^5 norms.
    return Models(out, (models.radius + gamma(4 * TERMS) * 2**TERMS * norm(c)) * UP + TINY)


def consolidate(state: Models, active: list[int]) -> Models:
    """Gather the errors of the state into one error symbol per active component.

    Lohner's method: the error set is enclosed in an orthogonal frame Q that follows its
    longest directions, so that it does not grow by being boxed anew at every step. The
    extent along each axis of Q is a sum of |a + b x|, convex in x, so it lies below the
    straight line between its values at x = -1 and x = 1.
    """
    errors = state.c[TERMS:, active]  # [2 m, k, rows]
    constant, slope = errors[::2], errors[1::2]
    k, rows = len(active), state.radius.shape[-1]
    columns = np.moveaxis(constant, (1, 2, 0), (1, 0, 2))  # [rows, k, m]
    order = np.argsort(-np.linalg.norm(columns, axis=1), axis=1)
    columns = np.take_along_axis(columns, order[:, None, :], axis=2)
    if columns.shape[2] < k:
        columns = np.concatenate([columns, np.zeros((rows, k, k - columns.shape[2]))], axis=2)
    frame = np.linalg.qr(columns)[0][:, :, :k]  # [rows, k, k]
    turned0 = np.einsum("rki,mkr->mir", frame, constant)
    turned1 = np.einsum("rki,mkr->mir", frame, slope)
    radius = state.radius[active]
    extent = np.einsum("rki,kr->ir", np.abs(frame), radius)
    right = (np.abs(turned0 + turned1).sum(axis=0) + extent) * UP
    left = (np.abs(turned0 - turned1).sum(axis=0) + extent) * UP
    half_sum, half_difference = (right + left) / 2 * UP, (right - left) / 2
    c = np.zeros((TERMS + 2 * k, *state.c.shape[1:]))
    c[:TERMS] = state.c[:TERMS]
    for i in range(k):
        direction = frame[:, :, i].T  # [k, rows]
        c[TERMS + 2 * i, active] = direction * half_sum[i]
        c[TERMS + 2 * i + 1, active] = direction * half_difference[i]
    # A vector e is Q (Q^T e) + (I - Q Q^T) e; the second part is what Q lacks in being
    # orthogonal, bounded row by row. All products above round as well.
    lack = np.abs(np.einsum("rki,rli->rkl", frame, frame) - np.eye(k))
    # Q's rows are no longer than the square root of this: near 1, whatever QR returned.
    rounding = 2.0**-48 * (1 + lack.max(axis=(1, 2)))
    lack = lack + rounding[:, None, None]
    size = error_spread(Models(state.c[:, active], radius))
    rest = np.einsum("rkl,lr->kr", lack, size) * UP
    rest = rest + rounding * size.sum(axis=0)
    out = np.array(state.radius)
    out[active] = rest * UP + TINY
    return Models(c, out)

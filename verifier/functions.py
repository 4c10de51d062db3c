"""Functions of Taylor models: tanh, sigmoid, sin, cos, tan, reciprocal.

For z = p(x) + l with p the polynomial part and l the error part, |l| <= lambda:

    g(z) = g(p(x)) + g'(p(x)) l + g''(.) l^2 / 2

The coefficients of g(p(x)) follow from the differential equation of g by recurrence. The
same recurrence on absolute values ("majorant"), begun with bounds of the values over the
whole row, bounds the Taylor coefficients at every x in [-1, 1]; the one of order DEGREE + 1
is Lagrange's remainder. The computed coefficients err by less than ROUNDING times the
majorant's sum (docs/soundness.md).
"""

from __future__ import annotations

import math

import numpy as np

from verifier.elementary import SIN_COS_RANGE, sin_cos, tanh_pair
from verifier.models import DEGREE, TERMS, Array, Models, bounds, error_spread
from verifier.rounding import TINY, UP, U

#: Relative to the sum of the majorant's coefficients.
ROUNDING = 2.0**-42

_BINOMIAL = np.array(
    [[math.comb(j, i) if j >= i else 0 for j in range(TERMS)] for i in range(TERMS)], dtype=float
)


def _majorant(p: Array) -> Array:
    """Return bounds Z[i] >= |p^(i)(x) / i!| for i >= 1; Z[0]: how far p strays from p[0]."""
    absolute = np.abs(p)
    return np.tensordot(_BINOMIAL[:, 1:], absolute[1:], axes=(1, 0)) * UP


def _sum_products(a: list[Array], b: list[Array], k: int) -> Array:
    """Return sum over i = 1..k of i a[i] b[k - i], for lists where a[i] may end early."""
    total = a[1] * b[k - 1]
    for i in range(2, min(k, len(a) - 1) + 1):
        total = total + i * (a[i] * b[k - i])
    return total


def _square(a: list[Array], k: int) -> Array:
    """Return the coefficient k >= 1 of a(x)^2."""
    total = a[0] * a[k] * 2
    for i in range(1, (k + 1) // 2):
        total = total + 2 * (a[i] * a[k - i])
    if k % 2 == 0:
        total = total + a[k // 2] * a[k // 2]
    return total


def _assemble(
    z: Models,
    value: list[Array],
    slope: tuple[Array, Array],
    slope_size: tuple[Array, Array],
    slope_rest: Array,
    curve_most: Array | float,
    remainder: Array,
    size: Array,
) -> Models:
    """Return the models of g(z).

    value: coefficients of g(p(x)); slope: the first two of g'(p(x)); slope_size: the
    majorant's, the first of which bounds |g'(p(x))|; slope_rest: bound of the rest of
    g'(p(x)) beyond its first two; curve_most: of |g''| on the whole range; remainder: of
    g(p(x)) beyond its polynomial; size: of all coefficients together, for rounding.
    """
    error = z.c[TERMS:]
    c = np.empty((len(z.c), *z.c.shape[1:]))
    for k, coefficient in enumerate(value):
        c[k] = coefficient
    radius = remainder + slope_size[0] * z.radius + ROUNDING * size
    stray = error_spread(z)
    radius = radius + 0.5 * curve_most * stray * stray
    if len(error):
        c[TERMS:] = slope[0] * error
        c[TERMS + 1 :: 2] += slope[1] * error[::2]
        total = np.abs(error).sum(axis=0)
        radius = radius + np.abs(slope[1]) * np.abs(error[1::2]).sum(axis=0) + slope_rest * total
        radius = radius + ROUNDING * (slope_size[0] + slope_size[1]) * total
    return Models(c, radius * UP + TINY)


def tanh(z: Models) -> Models:
    """Enclose the hyperbolic tangent: h' = z' (1 - h^2)."""
    p = list(z.c[:TERMS])
    h0, q0 = tanh_pair(p[0])
    h, q = [h0], [q0]
    for k in range(1, TERMS):
        h.append(_sum_products(p, q, k) / k)
        if k < DEGREE:
            q.append(-_square(h, k))
    zz = list(_majorant(z.c[:TERMS]))
    reach = np.maximum(np.abs(p[0]) - zz[0] * UP, 0)
    most_h, _ = tanh_pair(np.abs(p[0]) + zz[0])
    hh, qq = [np.minimum(most_h * UP, 1.0)], [np.minimum(tanh_pair(reach)[1] * UP, 1.0)]
    for k in range(1, TERMS + 1):
        hh.append(_sum_products(zz, qq, k) / k)
        qq.append(_square(hh, k))
    return _assemble(
        z,
        h,
        (q[0], q[1]),
        (qq[0], qq[1]),
        qq[2] * UP,
        0.77,  # |tanh''| <= 4 / (3 sqrt 3) = 0.7698...
        hh[TERMS] * UP,
        sum(hh[:TERMS], np.zeros_like(hh[0])),
    )


def sigmoid(z: Models) -> Models:
    """Return 1 / (1 + exp(-z)) = (1 + tanh(z / 2)) / 2."""
    return tanh(z.times(0.5)).times(0.5).plus(0.5)


def relu(z: Models) -> Models:
    """Return max(z, 0): exact where the sign is known, else the chord over [low, high].

    The chord lies above; halfway down to the kink is the middle of what is possible.
    """
    low, high = bounds(z)
    mixed = (low < 0) & (high > 0)
    share = np.where(mixed, high / np.where(mixed, high - low, 1.0), (low >= 0).astype(float))
    middle = np.where(mixed, -0.5 * share * low, 0.0)
    # share is rounded by 2 U relative; |z| is at most max(-low, high).
    slack = middle * UP + np.where(mixed, 4 * U * (high - low), 0.0)
    return z.times(share).plus(middle).widen(slack)


def sine_cosine(z: Models) -> tuple[Models, Models]:
    """Return sin(z) and cos(z): s' = z' c, c' = -z' s."""
    p = list(z.c[:TERMS])
    s0, c0 = sin_cos(np.clip(p[0], -SIN_COS_RANGE, SIN_COS_RANGE))
    s, c = [s0], [c0]
    for k in range(1, TERMS):
        s_next = _sum_products(p, c, k) / k
        c.append(-_sum_products(p, s, k) / k)
        s.append(s_next)
    zz = list(_majorant(z.c[:TERMS]))
    m = [np.ones_like(p[0])]
    for k in range(1, TERMS + 1):
        m.append(_sum_products(zz, m, k) / k)
    size = np.where(np.abs(p[0]) < SIN_COS_RANGE, sum(m[:TERMS], np.zeros_like(m[0])), np.inf)
    sizes = (m[0] * UP, m[1] * UP)
    rest = m[2] * UP
    sine = _assemble(z, s, (c[0], c[1]), sizes, rest, 1.0, m[TERMS] * UP, size)
    cosine = _assemble(z, c, (-s[0], -s[1]), sizes, rest, 1.0, m[TERMS] * UP, size)
    return sine, cosine


def reciprocal(z: Models) -> Models:
    """Return 1 / z; the caller makes sure that z keeps away from 0 (else radius is inf)."""
    p = list(z.c[:TERMS])
    zz = list(_majorant(z.c[:TERMS]))
    low, high = bounds(z)
    nearest = np.maximum(low, -high)  # the least |z| of all members, errors included
    good = nearest > 0
    nearest = np.where(good, nearest, 1.0)
    # 1 / p(x) is wanted on the polynomial part alone, which reaches no nearer to 0.
    q0 = 1 / np.where(good, p[0], 1.0)
    q = [q0]
    for k in range(1, TERMS):
        total = p[1] * q[k - 1]
        for i in range(2, k + 1):
            total = total + p[i] * q[k - i]
        q.append(-q0 * total)
    qq = [1 / nearest * UP]
    for k in range(1, TERMS + 1):
        total = zz[1] * qq[k - 1]
        for i in range(2, min(k, DEGREE) + 1):
            total = total + zz[i] * qq[k - i]
        qq.append(qq[0] * total)
    slope = (-q[0] * q[0], -2 * q[0] * q[1])
    result = _assemble(
        z,
        q,
        slope,
        (qq[0] * qq[0] * UP, 2 * qq[0] * qq[1] * UP),
        (2 * qq[0] * qq[2] + qq[1] * qq[1]) * UP,
        2 * qq[0] * qq[0] * qq[0] * UP,
        qq[TERMS] * UP,
        sum(qq[:TERMS], np.zeros_like(qq[0])),
    )
    return Models(result.c, np.where(good, result.radius, np.inf))


def tan(z: Models) -> Models:
    """Enclose the tangent: t' = z' (1 + t^2); infinite radius unless |z| stays below 1."""
    p = list(z.c[:TERMS])
    low, high = bounds(z)
    most = np.maximum(-low, high)
    good = most < 1.0
    p[0] = np.where(good, p[0], 0.0)
    sine, cosine = sin_cos(p[0])
    t, y = [sine / cosine], [1 / (cosine * cosine)]
    for k in range(1, TERMS):
        t.append(_sum_products(p, y, k) / k)
        if k < DEGREE:
            y.append(_square(t, k))
    zz = list(_majorant(z.c[:TERMS]))
    sine, cosine = sin_cos(np.where(good, most, 0.0))
    # sin errs by 16 U, cos by as much and is above 0.54.
    tt = [sine / cosine * (1 + 2.0**-30) + 2.0**-45]
    yy = [1 + tt[0] * tt[0] * UP]
    for k in range(1, TERMS + 1):
        tt.append(_sum_products(zz, yy, k) / k)
        yy.append(_square(tt, k))
    result = _assemble(
        z,
        t,
        (y[0], y[1]),
        (yy[0] * UP, yy[1] * UP),
        yy[2] * UP,
        2 * tt[0] * yy[0] * UP,
        tt[TERMS] * UP,
        sum(tt[:TERMS], np.ones_like(tt[0])),
    )
    return Models(result.c, np.where(good, result.radius, np.inf))

"""Functions of Taylor models: tanh, sigmoid, sin, cos, tan, reciprocal.

For z = p(x) + l with p the polynomial part and l the error part, |l| <= lambda:

    g(z) = g(p(x)) + g'(p(x)) l + g''(.) l^2 / 2

or, where products of symbols are known, with f the first order of the first symbols in l:

    g(z) = g(p(x)) + g'(p(x)) l + g''(p(0)) f^2 / 2 + rest

The coefficients of g(p(x)) follow from the differential equation of g by recurrence. The
same recurrence on absolute values ("majorant"), begun with bounds of the values over the
whole row, bounds the Taylor coefficients at every x in [-1, 1]; the one of order DEGREE + 1
is Lagrange's remainder. The computed coefficients err by less than ROUNDING times the
majorant's sum (docs/soundness.md).

The functions take models of a trace, or batches.
"""

from __future__ import annotations

import math

from verifier.arithmetic import (
    DEGREE,
    KNOWN,
    TERMS,
    Model,
    add_products,
    based,
    bounds,
    error_spread,
    total_size,
    unless,
)
from verifier.compiled.trace import Value, maximum, minimum, where
from verifier.compiled.trace import total as summed
from verifier.elementary import SIN_COS_RANGE, sin_cos, tanh_pair
from verifier.models import lifted
from verifier.rounding import TINY, UP, U

#: Relative to the sum of the majorant's coefficients.
ROUNDING = 2.0**-42


def _majorant(p: list[Value]) -> list[Value]:
    """Return bounds Z[i] >= |p^(i)(x) / i!| for i >= 1; Z[0]: how far p strays from p[0]."""
    return [
        summed([math.comb(j, i) * abs(p[j]) for j in range(max(i, 1), TERMS)]) * UP
        for i in range(TERMS)
    ]


def _sum_products(a: list[Value], b: list[Value], k: int) -> Value:
    """Return sum over i = 1..k of i a[i] b[k - i], for lists where a[i] may end early."""
    terms = [a[i] * b[k - i] for i in range(1, min(k, len(a) - 1) + 1)]
    return summed([terms[0], *(i * term for i, term in enumerate(terms[1:], 2))])


def _integral(a: list[Value], b: list[Value], k: int) -> Value:
    """Return the coefficient k of the integral of a'(x) b(x)."""
    return _sum_products(a, b, k) * (1 / k)


def _square(a: list[Value], k: int) -> Value:
    """Return the coefficient k >= 1 of a(x)^2."""
    total = 2.0 * summed([a[i] * a[k - i] for i in range((k + 1) // 2)])
    return total + a[k // 2] * a[k // 2] if k % 2 == 0 else total


def _assemble(
    z: Model,
    value: list[Value],
    slope: tuple[Value, Value],
    slope_size: tuple[Value, Value],
    slope_rest: Value,
    curve: Value,
    curve_most: Value | float,
    third_most: Value | float,
    remainder: Value,
    size: Value,
) -> Model:
    """Return the model of g(z).

    value: coefficients of g(p(x)); slope: the first two of g'(p(x)); slope_size: the
    majorant's, the first of which bounds |g'(p(x))|; slope_rest: bound of the rest of
    g'(p(x)) beyond its first two; curve: g''(p(0)) / 2; curve_most, third_most: of |g''| and
    |g'''| on the whole range; remainder: of g(p(x)) beyond its polynomial; size: of all
    coefficients together, for rounding.
    """
    c, error = list(value), z.e
    # The last summand is NaN where the argument is not finite.
    radius = remainder + slope_size[0] * z.radius + ROUNDING * size + 0.0 * z.c[0]
    stray = error_spread(z)
    plain = 0.5 * curve_most * (stray * stray)
    line, bent = None, plain
    if len(error) >= 2 * KNOWN:
        # |g''(p(x)) - g''(p(0))| <= third_most far, and l^2 = f^2 + 2 f (l - f) + (l - f)^2.
        line, others = based(error)
        base, far = total_size(line), _majorant(z.p)[0]
        others = (others + z.radius) * UP
        bent = third_most * (stray * stray) * (0.5 * far + stray * (1 / 6))
        bent = bent + abs(curve) * (others * (2.0 * base + others))
        bent = bent + ROUNDING * (slope_size[0] + curve_most) * (base * base)
        curve = where(bent < plain, curve, 0.0)
    radius = radius + minimum(bent, plain)
    if error:
        for j, x in enumerate(error):
            c.append(slope[0] * x if j % 2 == 0 else slope[0] * x + slope[1] * error[j - 1])
        total = total_size(error)
        radius = radius + abs(slope[1]) * total_size(error[1::2]) + slope_rest * total
        radius = radius + ROUNDING * (slope_size[0] + slope_size[1]) * total
    if line is not None:
        add_products(c, line, [curve * x for x in line])
    return Model(c, radius * UP + TINY)


@lifted
def tanh(z: Model) -> Model:
    """Enclose the hyperbolic tangent: h' = z' (1 - h^2)."""
    p = z.p
    h0, q0 = tanh_pair(p[0])
    h, q = [h0], [q0]
    for k in range(1, TERMS):
        h.append(_integral(p, q, k))
        if k < DEGREE:
            q.append(-_square(h, k))
    zz = _majorant(p)
    # q = 1 - h^2 and h grow from p(0) by no more than this, since (ln q)' = -2 h z' and |h| < 1;
    # exp(2 d) <= 1 + 2 d + 4 d^2 for d < 0.5.
    far = zz[0]
    grown = q0 * (1.0 + 2.0 * far + 4.0 * (far * far)) * UP
    most = where(far < 0.5, minimum(grown, 1.0), 1.0)
    hh, qq = [minimum((abs(h0) + most * far) * UP, 1.0)], [most]
    for k in range(1, TERMS + 1):
        hh.append(_integral(zz, qq, k))
        qq.append(_square(hh, k))
    return _assemble(
        z,
        h,
        (q[0], q[1]),
        (qq[0], qq[1]),
        qq[2] * UP,
        -h[0] * q[0],
        0.77,  # |tanh''| <= 4 / (3 sqrt 3) = 0.7698...
        2.0,
        hh[TERMS] * UP,
        summed(hh[:TERMS]),
    )


@lifted
def sigmoid(z: Model) -> Model:
    """Return 1 / (1 + exp(-z)) = (1 + tanh(z / 2)) / 2."""
    return tanh(z.times(0.5)).times(0.5).plus(0.5)


@lifted
def relu(z: Model) -> Model:
    """Return max(z, 0): exact where the sign is known, else the chord over [low, high].

    The chord lies above; halfway down to the kink is the middle of what is possible.
    """
    low, high = bounds(z)
    mixed = (low < 0.0) & (high > 0.0)
    share = where(mixed, high / where(mixed, high - low, 1.0), where(low >= 0.0, 1.0, 0.0))
    middle = where(mixed, -0.5 * share * low, 0.0)
    # share is rounded by 2 U relative; |z| is at most max(-low, high).
    slack = middle * UP + where(mixed, 4 * U * (high - low), 0.0)
    return z.times(share).plus(middle).widen(slack)


@lifted
def sine_cosine(z: Model) -> tuple[Model, Model]:
    """Return sin(z) and cos(z): s' = z' c, c' = -z' s."""
    p = z.p
    s0, c0 = sin_cos(maximum(minimum(p[0], SIN_COS_RANGE), -SIN_COS_RANGE))
    s, c = [s0], [c0]
    for k in range(1, TERMS):
        s_next = _integral(p, c, k)
        c.append(-_integral(p, s, k))
        s.append(s_next)
    zz = _majorant(p)
    one = p[0].trace.number(1.0)
    m = [one]
    for k in range(1, TERMS + 1):
        m.append(_integral(zz, m, k))
    size = where(abs(p[0]) < SIN_COS_RANGE, summed(m[:TERMS]), float("inf"))
    # |sin| and |cos| on the whole row: at its middle, and as far as p strays from there.
    sine_most, cosine_most = (minimum(abs(x) + (zz[0] + 2.0**-40), 1.0) * UP for x in (s0, c0))
    rest = m[2] * UP
    sine = _assemble(
        z,
        s,
        (c[0], c[1]),
        (cosine_most, m[1] * UP),
        rest,
        -0.5 * s[0],
        1.0,
        1.0,
        m[TERMS] * UP,
        size,
    )
    cosine = _assemble(
        z,
        c,
        (-s[0], -s[1]),
        (sine_most, m[1] * UP),
        rest,
        -0.5 * c[0],
        1.0,
        1.0,
        m[TERMS] * UP,
        size,
    )
    return sine, cosine


@lifted
def reciprocal(z: Model) -> Model:
    """Return 1 / z; the caller makes sure that z keeps away from 0 (else radius is inf)."""
    p, zz = z.p, _majorant(z.p)
    low, high = bounds(z)
    nearest = maximum(low, -high)  # the least |z| of all members, errors included
    good = nearest > 0.0
    nearest = where(good, nearest, 1.0)
    # 1 / p(x) is wanted on the polynomial part alone, which reaches no nearer to 0.
    q0 = 1.0 / where(good, p[0], 1.0)
    q, qq = [q0], [1.0 / nearest * UP]
    for k in range(1, TERMS):
        q.append(-q0 * summed([p[i] * q[k - i] for i in range(1, k + 1)]))
    for k in range(1, TERMS + 1):
        total = summed([zz[i] * qq[k - i] for i in range(1, min(k, DEGREE) + 1)])
        qq.append(qq[0] * total)
    result = _assemble(
        z,
        q,
        (-q0 * q0, -2.0 * q0 * q[1]),
        (qq[0] * qq[0] * UP, 2.0 * qq[0] * qq[1] * UP),
        (2.0 * qq[0] * qq[2] + qq[1] * qq[1]) * UP,
        q0 * q0 * q0,
        2.0 * qq[0] * qq[0] * qq[0] * UP,
        6.0 * (qq[0] * qq[0]) * (qq[0] * qq[0]) * UP,
        qq[TERMS] * UP,
        summed(qq[:TERMS]),
    )
    return unless(good, result)


@lifted
def tan(z: Model) -> Model:
    """Enclose the tangent: t' = z' (1 + t^2); infinite radius unless |z| stays below 1."""
    low, high = bounds(z)
    most = maximum(-low, high)
    good = most < 1.0
    p = [where(good, z.c[0], 0.0), *z.c[1:TERMS]]
    sine, cosine = sin_cos(p[0])
    share = 1.0 / cosine
    t, y = [sine * share], [share * share]
    for k in range(1, TERMS):
        t.append(_integral(p, y, k))
        if k < DEGREE:
            y.append(_square(t, k))
    zz = _majorant(z.p)
    sine, cosine = sin_cos(where(good, most, 0.0))
    # sin errs by 16 U, cos by as much and is above 0.54.
    tt = [sine / cosine * (1 + 2.0**-30) + 2.0**-45]
    yy = [1.0 + tt[0] * tt[0] * UP]
    for k in range(1, TERMS + 1):
        tt.append(_integral(zz, yy, k))
        yy.append(_square(tt, k))
    result = _assemble(
        z,
        t,
        (y[0], y[1]),
        (yy[0] * UP, yy[1] * UP),
        yy[2] * UP,
        t[0] * y[0],
        2.0 * tt[0] * yy[0] * UP,
        2.0 * yy[0] * (1.0 + 3.0 * (tt[0] * tt[0])) * UP,
        tt[TERMS] * UP,
        1.0 + summed(tt[:TERMS]),
    )
    return unless(good, result)

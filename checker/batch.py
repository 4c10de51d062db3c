"""The network on the Taylor models of many rows at once, in doubles with proved rounding.

The same rules as in ``checker.models`` (which says what a model is) on arrays of balls of shape
``[rows, neurons, entries]``. Doubles are coarser than Arb's 100 bits, for which rests are larger
by some 1e-14: what is not proved with them may be proved with Arb.
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb

import numpy as np
from numpy.typing import NDArray

from checker import balls
from checker.balls import Balls, add, around, between, exact, multiply, size, subtract, times
from checker.files import Layer
from checker.models import BASE, KNOWN, PAIRS, TERMS, Model

#: Returns the Taylor coefficients of orders 0 to n of a function, at all points of balls at once.
Taylor = Callable[[Balls, int], list[Balls]]

_BEND = 0.384900179459751  # more than 2 / (3 sqrt(3)), the largest |tanh''| / 2
_AT_ONCE = 32  # scans; of more, arrays do not fit the caches
_LARGE = 0.01  # errors beyond which lines may be better than series


class Batch:
    """The real-valued function of the float32 weights, for many scans at once."""

    def __init__(self, layers: list[Layer]) -> None:
        self._layers = [
            (x.weights.astype(float), x.biases.astype(float)[:, None], x.activation) for x in layers
        ]

    def steering(self, scans: list[list[Model]]) -> list[Model | None]:
        """Return the steering (rad) for each list of readings (m), None where it has no bounds.

        All models have the same number of symbols.
        """
        out: list[Model | None] = []
        for k in range(0, len(scans), _AT_ONCE):
            out += self._steering(scans[k : k + _AT_ONCE])
        return out

    def _steering(self, scans: list[list[Model]]) -> list[Model | None]:
        shape = len(scans), len(scans[0]), len(scans[0][0])
        z = balls.from_arb([x for scan in scans for model in scan for x in model], shape)
        with np.errstate(all="ignore"):
            for weights, biases, activation in self._layers:
                z = balls.product(weights, z)
                first = add(z.at(..., slice(0, 1)), exact(biases))
                z = settled(_joined([first, z.at(..., slice(1, None))]))
                z = settled(_ACTIVATIONS[activation](z)) if activation else z
        known = np.isfinite(z.middle + z.radius).all(axis=(1, 2))
        return [balls.to_arb(z.at(k, 0)) if known[k] else None for k in range(len(scans))]


def _joined(parts: list[Balls]) -> Balls:
    middles, radii = zip(*parts, strict=True)
    return Balls(np.concatenate(middles, axis=-1), np.concatenate(radii, axis=-1))


def settled(z: Balls) -> Balls:
    """Return models with exact coefficients: radii go into the rest, as |x|, |e_j| <= 1."""
    middle, radius = z.middle.copy(), np.zeros_like(z.radius)
    middle[..., -1] = 0
    radius[..., -1] = _sum([z.radius, np.abs(z.middle[..., -1:])])
    return Balls(middle, radius)


def _plus(entries: list[Balls], value: Balls) -> Balls:
    """Return models of c_0, c_1, ..., all a and all b, with a number added."""
    first = add(entries[0], exact(value.middle))
    entries = [x.at(..., None) for x in (first, *entries[1:TERMS])] + entries[TERMS:]
    return _joined([*entries, around(value.radius[..., None])])


def _parts(z: Balls) -> tuple[list[Balls], Balls, Balls, NDArray]:
    """Return the c_k, the a_j, the b_j (along the last axis) and the rest of settled models."""
    m = (z.middle.shape[-1] - TERMS - 1) // 2
    symbols = z.at(..., slice(TERMS, TERMS + m)), z.at(..., slice(TERMS + m, TERMS + 2 * m))
    return [z.at(..., k) for k in range(TERMS)], *symbols, z.radius[..., -1]


def _sum(terms: list[NDArray]) -> NDArray:
    """Return upper bounds of sums along the last axis of numbers that are not negative."""
    return balls.upper(balls.total(exact(np.concatenate(terms, axis=-1))))


def _magnitude(x: Balls) -> NDArray:
    """Return upper bounds of the sums of absolute values along the last axis."""
    return _sum([size(x)])


def _up(bound: NDArray) -> NDArray:
    """Return a bound after a few roundings of numbers that are not negative."""
    return bound * balls.UP + balls.TINY


def _from_zero(bound: NDArray) -> Balls:
    """Return balls that contain [0, bound]."""
    return between(np.zeros_like(bound), bound)


def _everywhere(p: list[Balls]) -> list[Balls]:
    """Return the coefficients in powers of t of p(x + t), for all x of [-1, 1] at once."""
    out = []
    for k in range(TERMS):
        sum_ = p[k]
        for j in range(k + 1, TERMS):
            term = times(p[j], comb(j, k))
            most = size(term)
            if (j - k) % 2:
                sum_ = add(sum_, around(most))
            else:  # times [0, 1]
                half = times(term, 0.5)
                sum_ = add(sum_, Balls(half.middle, _up(half.radius + most / 2)))
        out.append(sum_)
    return [*out, exact(np.zeros_like(p[0].middle))]


def _composed(g: list[Balls], p: list[Balls], n: int) -> list[Balls]:
    """Return orders 0 to n of g(p(t)), from the Taylor coefficients of g at p(0)."""
    out = [g[n]]
    for k in range(n - 1, -1, -1):
        longer = [g[k]]
        for order in range(1, n - k + 1):
            terms = [multiply(p[j], out[order - j]) for j in range(1, order + 1)]
            for term in terms[1:]:
                terms[0] = add(terms[0], term)
            longer.append(terms[0])
        out = longer
    return out


def _apply(z: Balls, taylor: Taylor) -> Balls:
    """Return models of g(z), g an analytic function, z settled: the rules of models._apply."""
    p, a, b, rest = _parts(z)
    g = taylor(p[0], TERMS - 1)
    q = _everywhere(p)
    h = taylor(q[0], TERMS)
    sixth = _composed(h, q, TERMS)[TERMS]
    second = add(times(multiply(h[2], q[2]), 2), times(multiply(h[3], multiply(q[1], q[1])), 3))
    size_b = _magnitude(b)
    all_symbols = _up(_magnitude(a) + size_b)
    stray = _up(all_symbols + rest)
    d0, d1 = g[1], times(multiply(g[2], p[1]), 2)
    sixth = multiply(sixth, between(np.zeros_like(stray), np.ones_like(stray)))
    mixed = around(_up(size(d1) * size_b + size(second) * all_symbols))
    cut = add(add(sixth, multiply(h[1], around(rest))), mixed)
    whole = taylor(add(q[0], around(stray)), 3)
    square = _up(stray * stray)
    last, bend = multiply(whole[2], _from_zero(square)), exact(np.zeros_like(stray))
    if a.middle.shape[-1] >= KNOWN:
        line = _magnitude(a.at(..., slice(0, BASE)))
        other = _up(_magnitude(a.at(..., slice(BASE, None))) + size_b + rest)
        off = times(multiply(h[3], subtract(q[0], p[0])), 3)
        bent = multiply(off, _from_zero(square))
        bent = add(bent, multiply(whole[3], around(_up(square * stray))))
        bent = add(bent, multiply(g[2], around(_up(2 * line * other))))
        bent = add(bent, multiply(g[2], _from_zero(_up(other * other))))
        better = size(bent) < size(last)
        last, bend = _chosen(better, bent, last), _chosen(better, g[2], bend)
    cut = add(cut, last)
    first = multiply(d0.at(..., None), a)
    both = add(multiply(d0.at(..., None), b), multiply(d1.at(..., None), a))
    if a.middle.shape[-1] >= KNOWN:
        products, more = _products(a, bend)
        first = _joined([
            first.at(..., slice(0, BASE)),
            add(first.at(..., slice(BASE, KNOWN)), products),
            first.at(..., slice(KNOWN, None)),
        ])  # fmt: skip
        cut = add(cut, more)
    return _plus([*_composed(g, p, TERMS - 1), first, both], cut)


def _products(a: Balls, bend: Balls) -> tuple[Balls, Balls]:
    """Return bend (sum_j a_j e_j)^2, j < BASE, as products of symbols, and what is constant."""
    terms, constant = [], exact(np.zeros_like(bend.middle))
    for i, j in PAIRS:
        term = multiply(bend, multiply(a.at(..., i), a.at(..., j)))
        if i == j:  # e^2 = (1 + (2 e^2 - 1)) / 2
            term = times(term, 0.5)
            constant = add(constant, term)
        else:
            term = times(term, 2)
        terms.append(term.at(..., None))
    return _joined(terms), constant


def _chosen(which: NDArray, x: Balls, y: Balls) -> Balls:
    """Return x where ``which``, else y."""
    return Balls(np.where(which, x.middle, y.middle), np.where(which, x.radius, y.radius))


# --- activations ------------------------------------------------------------------------------


def _range(z: Balls) -> Balls:
    """Return balls with all values of settled models."""
    p, a, b, rest = _parts(z)
    stray = _sum([size(a), size(b), rest[..., None]])
    return add(_everywhere(p)[0], around(stray))


def _tanh_taylor(y: Balls, n: int) -> list[Balls]:
    """Return the Taylor coefficients of tanh: g' = 1 - g^2."""
    wide = bool(y.radius.any())
    h = balls.tanh_between(y) if wide else balls.tanh(y.middle)
    one = exact(np.ones_like(h.middle))
    slope = subtract(one, multiply(h, h))
    slope = balls.clip(slope, 0, 1) if wide else slope
    bend = multiply(Balls(-h.middle, h.radius), slope)
    g = [h, slope, balls.clip(bend, -_BEND, _BEND) if wide else bend]
    while len(g) <= n:
        square = multiply(g[0], g[-1])
        for i in range(1, len(g)):
            square = add(square, multiply(g[i], g[-1 - i]))
        g.append(balls.over(square, -len(g)))
    return g


def _tanh(z: Balls) -> Balls:
    """Return the hyperbolic tangents: by their series, or by lines where errors are large."""
    series = _apply(z, _tanh_taylor)
    _, a, b, rest = _parts(z)
    large = _sum([size(a), size(b), rest[..., None]]) > _LARGE
    if not large.any():
        return series
    line = _tanh_line(z)
    better = large & (line.radius[..., -1] < series.radius[..., -1])
    return _chosen(better[..., None], line, series)


def _tanh_line(z: Balls) -> Balls:
    """Return tanh(z) as k z and what lies between: see models._tanh_line."""
    y = _range(z)
    low, high = balls.lower(y), balls.upper(y)
    ends = balls.tanh(low), balls.tanh(high)
    # Any place will do; its slope is enclosed.
    chord = (ends[1].middle - ends[0].middle) / (high - low)
    place = np.arctanh(np.clip(1 - chord, 0, 1 - 1e-9) ** 0.5)
    quarter = (high - low) / 4
    beside = (low > 0) | (high < 0)
    middle = np.abs(y.middle)
    place = np.where(beside, np.clip(place, middle - quarter, middle + quarter), place)
    place = np.maximum(np.where(np.isfinite(place), place, 0), 0)
    peak = balls.tanh(place)
    slope = subtract(exact(np.ones_like(place)), multiply(peak, peak))
    first, last, top = (
        subtract(t, multiply(slope, exact(x)))
        for t, x in ((ends[0], low), (ends[1], high), (peak, place))
    )
    most = np.maximum(balls.upper(first), np.where(high >= 0, balls.upper(top), balls.upper(last)))
    least = np.minimum(balls.lower(last), np.where(low <= 0, -balls.upper(top), balls.lower(first)))
    return _scaled(z, slope, between(least, most))


def _scaled(z: Balls, slope: Balls, value: Balls) -> Balls:
    """Return slope z + value."""
    p, a, b, rest = _parts(z)
    over = slope.at(..., None)
    entries = [*(multiply(x, slope) for x in p), multiply(a, over), multiply(b, over)]
    return _plus(entries, add(value, multiply(around(rest), slope)))


def _sigmoid(z: Balls) -> Balls:
    """Return (1 + tanh(z / 2)) / 2."""
    half = settled(times(_tanh(settled(times(z, 0.5))), 0.5))
    p, a, b, rest = _parts(half)
    return _plus([*p, a, b], Balls(np.full_like(rest, 0.5), rest))


def _relu(z: Balls) -> Balls:
    """Return max(z, 0): where its sign is open, a share of z and what that may lack."""
    y = _range(z)
    low, high = balls.lower(y), balls.upper(y)
    share = np.where(low >= 0, 1.0, np.where(high <= 0, 0.0, high / (high - low)))
    # max(y, 0) - share y is convex, 0 at 0, and so at most its larger end value.
    most = np.maximum(_up(share * -low), _up(_up(1 - share) * high))
    most = np.where((low >= 0) | (high <= 0), 0.0, most)
    return _scaled(z, exact(share), _from_zero(most))


_ACTIVATIONS = {"Tanh": _tanh, "Sigmoid": _sigmoid, "Relu": _relu}

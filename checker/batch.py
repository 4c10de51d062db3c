"""Taylor models of many rows at once, in doubles with proved rounding.

The same rules as in ``checker.models`` (which says what a model is) on arrays of balls whose last
axis is a model's entries. Doubles are coarser than Arb's 100 bits, for which rests are larger by
some 1e-14: what is not proved with them may be proved with Arb. In *settled* models all
coefficients are exact, and the rest has middle 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import factorial

import numpy as np
from flint import arb
from numpy.typing import NDArray

from checker import balls
from checker.balls import (
    Balls,
    add,
    around,
    between,
    exact,
    from_zero,
    multiply,
    raised,
    size,
    subtract,
    times,
)
from checker.files import Row
from checker.models import BASE, KNOWN, PAIRS, TERMS, Model
from checker.series import Series, Taylor, by_division, by_taylor, range_of_powers


def of_rows(rows: Sequence[Row]) -> Balls:
    """Return the models ``[rows, 4, entries]`` of the states of rows, settled."""
    centre, spread = np.array([row.centre for row in rows]), np.array([row.spread for row in rows])
    parts = [centre, spread[..., 0], spread[..., 1]]
    last = np.array([row.radius for row in rows])[..., None]
    middle = np.concatenate([*parts, np.zeros_like(last)], axis=-1)
    radius = np.zeros_like(middle)
    radius[..., -1:] = last
    return Balls(middle, radius)


def of_models(models: Sequence[Model]) -> Balls:
    """Return models ``[models, entries]`` of the same symbols, settled."""
    shape = len(models), len(models[0])
    return settled(balls.from_arb([x for model in models for x in model], shape))


def joined(parts: list[Balls]) -> Balls:
    """Return arrays one after the other along the last axis."""
    middles, radii = zip(*parts, strict=True)
    return Balls(np.concatenate(middles, axis=-1), np.concatenate(radii, axis=-1))


def by_entry(z: Balls) -> Balls:
    """Return models with the same entry of all of them side by side in memory.

    NumPy keeps that order in what it makes of them, and works fastest along it.
    """
    return Balls(*(np.moveaxis(np.ascontiguousarray(np.moveaxis(x, -1, 0)), 0, -1) for x in z))


def settled(z: Balls) -> Balls:
    """Return models with exact coefficients: radii go into the rest, as |x|, |e_j| <= 1."""
    middle, radius = z.middle.copy("K"), np.zeros_like(z.radius)
    middle[..., -1] = 0
    radius[..., -1] = upper_sum([z.radius, np.abs(z.middle[..., -1:])])
    return Balls(middle, radius)


def plus(entries: list[Balls], value: Balls) -> Balls:
    """Return models of c_0, c_1, ..., all a and all b, with a number added."""
    first = add(entries[0], exact(value.middle))
    entries = [x.at(..., None) for x in (first, *entries[1:TERMS])] + entries[TERMS:]
    return joined([*entries, around(value.radius[..., None])])


def parts(z: Balls) -> tuple[list[Balls], Balls, Balls, NDArray]:
    """Return the c_k, the a_j, the b_j (along the last axis) and the rest of settled models."""
    m = (z.middle.shape[-1] - TERMS - 1) // 2
    symbols = z.at(..., slice(TERMS, TERMS + m)), z.at(..., slice(TERMS + m, TERMS + 2 * m))
    return [z.at(..., k) for k in range(TERMS)], *symbols, z.radius[..., -1]


def upper_sum(terms: list[NDArray]) -> NDArray:
    """Return upper bounds of sums along the last axis of numbers that are not negative.

    A sum of n of them is off by at most (n - 1) U / (1 - (n - 1) U) times itself.
    """
    total = np.sum(terms[0], axis=-1)
    for term in terms[1:]:
        total = total + term.sum(-1)
    return total * (1 + 4 * sum(term.shape[-1] for term in terms) * balls.U)


def _magnitude(x: Balls) -> NDArray:
    """Return upper bounds of the sums of absolute values along the last axis."""
    return upper_sum([size(x)])


def apply(
    z: Balls, taylor: Taylor, series: Callable[[list[Balls], Taylor], Series] = by_taylor
) -> Balls:
    """Return models of g(z), g an analytic function, z settled: the rules of models._apply."""
    p, a, b, rest = parts(by_entry(z))
    g, within, h, orders, left, second = series(p, taylor)
    size_b = _magnitude(b)
    all_symbols = raised(_magnitude(a) + size_b)
    most = raised(all_symbols + rest)
    d0, d1 = g[1], times(multiply(g[2], p[1]), 2)
    mixed = around(raised(size(d1) * size_b + size(second) * all_symbols))
    cut = add(add(left, multiply(h[1], around(rest))), mixed)
    whole = taylor(add(within, around(most)), 3)
    square = raised(most * most)
    last, bend = multiply(whole[2], from_zero(square)), exact(np.zeros_like(most))
    if a.middle.shape[-1] >= KNOWN:
        line = _magnitude(a.at(..., slice(0, BASE)))
        other = raised(_magnitude(a.at(..., slice(BASE, None))) + size_b + rest)
        off = times(multiply(h[3], subtract(within, p[0])), 3)
        bent = multiply(off, from_zero(square))
        bent = add(bent, multiply(whole[3], around(raised(square * most))))
        bent = add(bent, multiply(g[2], around(raised(2 * line * other))))
        bent = add(bent, multiply(g[2], from_zero(raised(other * other))))
        better = size(bent) < size(last)
        last, bend = chosen(better, bent, last), chosen(better, g[2], bend)
    cut = add(cut, last)
    first = multiply(d0.at(..., None), a)
    both = add(multiply(d0.at(..., None), b), multiply(d1.at(..., None), a))
    if a.middle.shape[-1] >= KNOWN:
        products, more = _products(a, multiply(bend.at(..., None), a))
        first, cut = _with_products(first, products), add(cut, more)
    return plus([*orders, first, both], cut)


def product(z: Balls, w: Balls) -> Balls:
    """Return the products of settled models of the same symbols, settled."""
    (p, a, b, r), (q, c, d, s) = parts(z), parts(w)
    full: list[Balls] = []
    for k in range(2 * TERMS - 1):
        pairs = [(i, k - i) for i in range(TERMS) if 0 <= k - i < TERMS]
        full.append(_added([multiply(p[i], q[j]) for i, j in pairs]))

    def times_all(number: Balls, values: Balls) -> Balls:
        return multiply(number.at(..., None), values)

    first = add(times_all(p[0], c), times_all(q[0], a))
    second = _added([
        times_all(p[1], c), times_all(q[1], a), times_all(p[0], d), times_all(q[0], b)
    ])  # fmt: skip
    size_b, size_d = _magnitude(b), _magnitude(d)
    size_z, size_w = raised(_magnitude(a) + size_b), raised(_magnitude(c) + size_d)
    cut = [size(x) for x in full[TERMS:]]
    if a.middle.shape[-1] >= KNOWN:
        line = _magnitude(a.at(..., slice(0, BASE)))
        other_z = raised(_magnitude(a.at(..., slice(BASE, None))) + size_b)
        other_w = raised(_magnitude(c.at(..., slice(BASE, None))) + size_d)
        cut += [other_z * size_w, line * other_w]
        products, constant = _products(a, c)
        full[0] = add(full[0], constant)
        first = _with_products(first, products)
    else:
        cut.append(size_z * size_w)
    cut += [size(p[1]) * size_d, size(q[1]) * size_b]
    cut += [_sizes(p[2:]) * size_w, _sizes(q[2:]) * size_z]
    cut += [r * raised(_sizes(q) + size_w + s), s * raised(_sizes(p) + size_z)]
    rest = upper_sum([raised(x)[..., None] for x in cut])
    return settled(plus([*full[:TERMS], first, second], around(rest)))


def _sizes(p: list[Balls]) -> NDArray:
    return upper_sum([size(x)[..., None] for x in p])


def _added(terms: list[Balls]) -> Balls:
    total = terms[0]
    for term in terms[1:]:
        total = add(total, term)
    return total


def _with_products(first: Balls, products: Balls) -> Balls:
    """Return the a_j with those of products of symbols added."""
    return joined([
        first.at(..., slice(0, BASE)),
        add(first.at(..., slice(BASE, KNOWN)), products),
        first.at(..., slice(KNOWN, None)),
    ])  # fmt: skip


def _products(a: Balls, c: Balls) -> tuple[Balls, Balls]:
    """Return (sum_j a_j e_j) (sum_j c_j e_j), j < BASE, as products of symbols, and a constant."""
    terms, constant = [], exact(np.zeros(a.middle.shape[:-1]))
    for i, j in PAIRS:
        term = multiply(a.at(..., i), c.at(..., j))
        if i == j:  # e^2 = (1 + (2 e^2 - 1)) / 2
            term = times(term, 0.5)
            constant = add(constant, term)
        else:
            term = add(term, multiply(a.at(..., j), c.at(..., i)))
        terms.append(term.at(..., None))
    return joined(terms), constant


def chosen(which: NDArray, x: Balls, y: Balls) -> Balls:
    """Return x where ``which``, else y."""
    return Balls(np.where(which, x.middle, y.middle), np.where(which, x.radius, y.radius))


def stray(z: Balls) -> NDArray:
    """Return how far settled models may be from their polynomials in x."""
    _, a, b, rest = parts(z)
    return upper_sum([size(a), size(b), rest[..., None]])


def range_of(z: Balls) -> Balls:
    """Return balls with all values of settled models."""
    return add(range_of_powers([x.middle for x in parts(z)[0]]), around(stray(z)))


def scaled(z: Balls, slope: Balls, value: Balls) -> Balls:
    """Return slope z + value."""
    p, a, b, rest = parts(z)
    over = slope.at(..., None)
    entries = [*(multiply(x, slope) for x in p), multiply(a, over), multiply(b, over)]
    return plus(entries, add(value, multiply(around(rest), slope)))


def _sine_taylor(y: Balls, n: int, shift: int = 0) -> list[Balls]:
    """Return the Taylor coefficients of the sine; shift 1: of the cosine, its derivative."""
    pairs = [
        arb(middle, radius).sin_cos()
        for middle, radius in zip(y.middle.flat, y.radius.flat, strict=True)
    ]
    s, c = (balls.from_arb(list(values), y.middle.shape) for values in zip(*pairs, strict=True))
    cycle = [s, c, balls.negative(s), balls.negative(c)]
    return [balls.over(cycle[(k + shift) % 4], factorial(k)) for k in range(n + 1)]


def sine(z: Balls) -> Balls:
    """Return the sines, settled."""
    return settled(apply(z, _sine_taylor))


def cosine(z: Balls) -> Balls:
    """Return the cosines, settled."""
    return settled(apply(z, lambda y, n: _sine_taylor(y, n, 1)))


def riccati(g: list[Balls], sign: int, n: int) -> list[Balls]:
    """Continue the Taylor coefficients of a solution of g' = 1 + sign g^2 up to order n."""
    while len(g) <= n:
        square = _added([multiply(x, y) for x, y in zip(g, reversed(g), strict=True)])
        if len(g) == 1:
            square = add(square, exact(np.full_like(square.middle, sign)))
        g.append(balls.over(square, sign * len(g)))
    return g


def _reciprocal_taylor(y: Balls, n: int) -> list[Balls]:
    g = [balls.reciprocal(y)]
    turned = balls.negative(g[0])
    while len(g) <= n:
        g.append(multiply(g[-1], turned))
    return g


def reciprocal(z: Balls) -> Balls:
    """Return 1 / z, settled; not finite where z may be 0."""
    return settled(apply(z, _reciprocal_taylor, by_division))


def inverse(z: Balls) -> Balls:
    """Return 1 / z of positive models, settled: by a series, or a line if that is closer.

    On [a, b], 1 / u + k u is convex: largest at an end, and at least 2 sqrt(k), for any k > 0.
    """
    series, y = reciprocal(z), range_of(z)
    a, b = balls.lower(y), balls.upper(y)
    k = 1 / (a * b)
    ends = [add(balls.reciprocal(exact(x)), multiply(exact(k), exact(x))) for x in (a, b)]
    most = np.maximum(*map(balls.upper, ends))
    # A square root is rounded to nearest, too.
    values = between(2 * np.sqrt(k) * balls.DOWN, most)
    closer = ~(series.radius[..., -1] <= values.radius) & (a > 0)  # the line may be
    if closer.any():
        line = settled(scaled(z.at(closer), exact(-k[closer]), values.at(closer)))
        better = ~(series.radius[closer][..., -1] <= line.radius[..., -1])
        for whole, part in zip(series, line, strict=True):
            whole[closer] = np.where(better[..., None], part, whole[closer])
    return series

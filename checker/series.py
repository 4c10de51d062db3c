"""Functions along polynomials p(x), x in [-1, 1], in doubles: what ``batch`` makes models of.

A polynomial is its coefficients, arrays of one shape.
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from checker import balls
from checker.balls import (
    Balls,
    add,
    around,
    exact,
    from_zero,
    multiply,
    raised,
    size,
    subtract,
    times,
)
from checker.models import TERMS

#: Returns the Taylor coefficients of orders 0 to n of a function, at all points of balls at once.
Taylor = Callable[[Balls, int], list[Balls]]


class Series(NamedTuple):
    """What is known of an analytic function g along polynomials."""

    near: list[Balls]  #: Taylor coefficients of g at p(0), up to order 2 at least
    within: Balls  #: all p(x)
    everywhere: list[Balls]  #: Taylor coefficients of g at all p(x), up to order 3 at least
    orders: list[Balls]  #: c_0 .. c_5
    left: Balls  #: g(p(x)) - sum_k c_k x^k for all x and all c_k of the balls
    second: Balls  #: the coefficient of order 2 of g'(p) at all x, or minus it


def by_taylor(p: list[Balls], taylor: Taylor) -> Series:
    """Return the series of any function: by Taylor's theorem in x, as in models._apply."""
    g, q = taylor(p[0], TERMS - 1), _everywhere(p)
    h = taylor(q[0], TERMS)
    sixth = _order(TERMS, _composed(h[1:], q, TERMS - 1), q)
    second = add(times(multiply(h[2], q[2]), 2), times(multiply(h[3], multiply(q[1], q[1])), 3))
    left = multiply(sixth, from_zero(np.ones_like(sixth.middle)))
    return Series(g, q[0], h, _composed(g, p, TERMS - 1), left, second)


def by_division(p: list[Balls], taylor: Taylor) -> Series:
    """Return the series of 1 / y, for exact p: 1 / p - r = (1 - p r) / p for any polynomial r.

    With r as chosen here, p r = 1 + x^6 d(x), but for rounding: in order 0 of at most U, in order
    k of at most 8 U sum_j |p_j r_(k-j)|, j > 0. Likewise p (s + t x) = 1 + x^2 f(x) with 1 / p(0)
    and its slope, s and t, so that 1 / p^2 = (s + t x - x^2 f / p)^2.
    """
    c = [x.middle for x in p]
    r = [1 / c[0]]
    for k in range(1, TERMS):
        r.append(-r[0] * _sum([c[j] * r[k - j] for j in range(1, k + 1)]))
    d = [
        _sum([c[k - j] * r[j] for j in range(k - TERMS + 1, TERMS)])
        for k in range(TERMS, 2 * TERMS - 1)
    ]
    within = range_of_powers(c)
    g, h = taylor(p[0], 2), taylor(within, 3)
    share = from_zero(np.ones_like(r[0]))  # of x^6
    left = multiply(Balls(-d[0], raised(_sizes(d[1:]))), share)
    more = _sizes(c[1:])
    rounding = raised(balls.U * (1 + 9 * more * _sizes(r)) + balls.TINY * (np.abs(c[0]) + more))
    left = multiply(h[0], add(left, around(rounding)))
    s, t = g[0], multiply(g[1], p[1])
    f = add(multiply(s, p[2]), multiply(t, p[1]))
    higher = size(s) * _sizes(c[3:]) + size(t) * _sizes(c[2:])
    w = multiply(add(f, around(raised(higher))), h[0])
    second = subtract(_square(add(t, around(size(w)))), times(multiply(s, w), 2))
    return Series(g, within, h, list(map(exact, r)), left, second)


def range_of_powers(c: list[NDArray]) -> Balls:
    """Return balls with all values of polynomials: x, x^3, x^5 in [-1, 1], x^2, x^4 in [0, 1]."""
    even = c[2] + c[4]
    sizes = np.abs(c[2]) + np.abs(c[4])
    radius = _sizes(c[1::2]) + sizes / 2 + 2 * balls.U * (np.abs(c[0]) + sizes)
    return Balls(c[0] + even / 2, raised(radius))


def _sum(terms: list[NDArray]) -> NDArray:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def _sizes(c: list[NDArray]) -> NDArray:
    """Return sums of absolute values, rounded."""
    return _sum(list(map(np.abs, c)))


def _square(x: Balls) -> Balls:
    return multiply(x, x)


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
                sum_ = add(sum_, Balls(half.middle, raised(half.radius + most / 2)))
        out.append(sum_)
    return out


def _composed(g: list[Balls], p: list[Balls], n: int) -> list[Balls]:
    """Return orders 0 to n of g(p(t)), from the Taylor coefficients of g at p(0)."""
    out = [g[n]]
    for k in range(n - 1, -1, -1):
        out = [g[k], *(_order(order, out, p) for order in range(1, n - k + 1))]
    return out


def _order(k: int, g: list[Balls], p: list[Balls]) -> Balls:
    """Return order k > 0 of g(t) (p(t) - p(0))."""
    total = multiply(p[1], g[k - 1])
    for j in range(2, min(k, len(p) - 1) + 1):
        total = add(total, multiply(p[j], g[k - j]))
    return total

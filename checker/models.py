"""Taylor models on Arb balls: the checker's arithmetic.

A model is a list of balls ``[c_0 .. c_5, a_1 .. a_m, b_1 .. b_m, rest]`` and stands for

    sum_k c_k x^k + sum_j (a_j + b_j x) e_j + rest,   x, e_j in [-1, 1]

with the same x and e for all models of a row. In models of at least KNOWN symbols the first BASE
are followed by their products, 2 e_i^2 - 1 and e_i e_j by PAIRS. Every operation returns a model
that contains the exact result for all x, e and all values in the balls: rounding is inside the
balls (100 bits), what is cut off goes into ``rest``, a ball around 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from math import atanh, factorial
from operator import mul

from flint import arb, arb_mat, arb_poly, arb_series, ctx

ctx.prec = 100  # bits
ctx.cap = 8  # power series are cut off beyond the length that is used here, 7

Model = list[arb]
#: Returns the Taylor coefficients of orders 0 to n of a function, at all points of a ball at once.
Taylor = Callable[[arb, int], list[arb]]

TERMS = 6
BASE = 3
PAIRS = [(i, j) for i in range(BASE) for j in range(i, BASE)]
KNOWN = BASE + len(PAIRS)
ZERO, ONE, UNIT, SHARE = arb(0), arb(1), arb(0, 1), arb(0.5, 0.5)  # 0, 1, [-1, 1], [0, 1]
HALF = arb(0.5)
_POWERS = [ONE, UNIT, SHARE, UNIT, SHARE, UNIT]  # what x^0 .. x^5 range over


def symbols(z: Model) -> int:
    """Return the number m of symbols."""
    return (len(z) - TERMS - 1) // 2


def split(z: Model) -> tuple[list[arb], list[arb], list[arb], arb]:
    """Return the c_k, the a_j, the b_j, and the rest."""
    m = symbols(z)
    return z[:TERMS], z[TERMS : TERMS + m], z[TERMS + m : -1], z[-1]


@cache
def _ranges(length: int) -> list[arb]:
    """Return what the factors of a model of so many entries range over."""
    return [*_POWERS, *[UNIT] * (length - TERMS - 1), ONE]


def bound(z: Model) -> arb:
    """Return a ball that contains all values of a model."""
    return sum(map(mul, z, _ranges(len(z))), ZERO)


def bounds(matrix: arb_mat) -> list[arb]:
    """Return a ball for each model, given as the rows of a matrix."""
    return (matrix * arb_mat([[r] for r in _ranges(matrix.ncols())])).entries()


def constant(value: arb, m: int) -> Model:
    """Return the model of a number; the ball's radius goes into the rest."""
    return plus([ZERO] * (TERMS + 2 * m + 1), value)


def add(z: Model, w: Model) -> Model:
    """Return the sum."""
    return [x + y for x, y in zip(z, w, strict=True)]


def subtract(z: Model, w: Model) -> Model:
    """Return the difference."""
    return [x - y for x, y in zip(z, w, strict=True)]


def negative(z: Model) -> Model:
    """Return -z."""
    return [-x for x in z]


def scale(z: Model, factor: arb) -> Model:
    """Return the multiple by a number, known or in a ball (rest then stays around 0)."""
    return [x * factor for x in z]


def plus(z: Model, value: arb) -> Model:
    """Return z + value; the ball's radius goes into the rest."""
    return [z[0] + value.mid(), *z[1:-1], z[-1] + (value - value.mid())]


def line(face: Sequence[float], s: Model, f: Model) -> Model:
    """Return a s + b f - c of a face (a, b, c)."""
    a, b, c = map(arb, face)
    return plus(add(scale(s, a), scale(f, b)), -c)


def length(face: Sequence[float]) -> arb:
    """Return the length of the normal of a face (a, b, c)."""
    return (arb(face[0]) * face[0] + arb(face[1]) * face[1]).sqrt()


def magnitude(values: Sequence[arb]) -> arb:
    """Return the sum of absolute values."""
    return sum(map(abs, values), ZERO)


def multiply(z: Model, w: Model) -> Model:
    """Return the product of two models of the same symbols."""
    (p, a, b, r), (q, c, d, s) = split(z), split(w)
    full = (arb_poly(p) * arb_poly(q)).coeffs()
    full += [ZERO] * (2 * TERMS - 1 - len(full))
    first = [p[0] * y + q[0] * x for x, y in zip(a, c, strict=True)]
    second = [p[1] * y + q[1] * x for x, y in zip(a, c, strict=True)]
    second = [t + p[0] * y + q[0] * x for t, x, y in zip(second, b, d, strict=True)]
    size_b, size_d = magnitude(b), magnitude(d)
    size_z, size_w = magnitude(a) + size_b, magnitude(c) + size_d
    cut = magnitude(full[TERMS:])
    if len(a) >= KNOWN:
        cut += (size_z - magnitude(a[:BASE])) * size_w + magnitude(a[:BASE]) * (
            magnitude(c[BASE:]) + size_d
        )
        full[0] += _add_products(first, a, c)
    else:
        cut += size_z * size_w
    cut += abs(p[1]) * size_d + magnitude(p[2:]) * size_w
    cut += abs(q[1]) * size_b + magnitude(q[2:]) * size_z
    rest = abs(r) * magnitude(w) + abs(s) * magnitude(z[:-1])
    return [*full[:TERMS], *first, *second, (cut + rest) * UNIT]


def _add_products(to: list[arb], a: list[arb], c: list[arb]) -> arb:
    """Add the product of sum_j a_j e_j and sum_j c_j e_j, j < BASE, to symbols; return the rest."""
    total = ZERO
    for k, (i, j) in enumerate(PAIRS, BASE):
        if i == j:  # e^2 = (1 + (2 e^2 - 1)) / 2
            to[k] += a[i] * c[i] / 2
            total += a[i] * c[i] / 2
        else:
            to[k] += a[i] * c[j] + a[j] * c[i]
    return total


def shifted(p: list[arb], middle: arb, half: arb, length: int) -> list[arb]:
    """Return the coefficients in powers of t of p(middle + half t)."""
    moved = arb_poly(p)(arb_poly([middle, half])).coeffs()
    return moved + [ZERO] * (length - len(moved))


def _composed(g: list[arb], p: list[arb]) -> arb_series:
    """Return the power series of g(p(t)), from the Taylor coefficients of g at p(0)."""
    if all(c == 0 for c in p[1:]):
        return arb_series(g[:1], len(p))
    return arb_series(g, len(p))(arb_series([ZERO, *p[1:]], len(p)))


def _apply(z: Model, taylor: Taylor) -> Model:
    """Return the model of g(z), g an analytic function; ArithmeticError outside of its domain.

    With z = p(x) + l, l the symbols and the rest: g(z) = g(p(x)) + g'(p(x)) l + g''(.) l^2/2, or
    g(p(x)) + g'(p(x)) l + g''(p(x)) l^2/2 + g'''(.) l^3/6 where squares are known.
    Taylor's theorem in x: the coefficients of order 6 of g(p), 2 of g'(p), at all of [-1, 1].
    """
    p, a, b, rest = split(z)
    g = taylor(p[0], TERMS - 1)
    q = shifted(p, UNIT, ONE, TERMS + 1)
    h = taylor(q[0], TERMS)
    sixth, second = _composed(h, q)[TERMS], 2 * h[2] * q[2] + 3 * h[3] * q[1] * q[1]
    size_b = magnitude(b)
    size = magnitude(a) + size_b
    stray = size + abs(rest)
    d0, d1 = g[1], 2 * g[2] * p[1]
    cut = sixth * SHARE + h[1] * rest + (abs(d1) * size_b + abs(second) * size) * UNIT
    whole = taylor(q[0] + stray * UNIT, 3)
    plain, bend = whole[2] * (stray * stray) * SHARE, ZERO
    if len(a) >= KNOWN:
        line = magnitude(a[:BASE])
        other = magnitude(a[BASE:]) + size_b + abs(rest)
        bent = 3 * h[3] * (q[0] - p[0]) * (stray * stray) * SHARE + whole[3] * stray**3 * UNIT
        bent += g[2] * (2 * line * other * UNIT + other * other * SHARE)
        if abs(bent).upper() < abs(plain).upper():
            plain, bend = bent, g[2]
    cut += plain
    if not cut.is_finite():
        raise ArithmeticError("a function is not defined everywhere")
    series = _composed(g, p)
    first = [d0 * x for x in a]
    mixed = [d0 * y + d1 * x for x, y in zip(a, b, strict=True)]
    if len(a) >= KNOWN:
        cut += _add_products(first, a, [bend * x for x in a[:BASE]])
    return plus([*(series[k] for k in range(TERMS)), *first, *mixed, ZERO], cut)


def _riccati(g: list[arb], sign: int, n: int) -> list[arb]:
    """Continue the Taylor coefficients of a solution of g' = 1 + sign g^2 up to order n."""
    while len(g) <= n:
        square = sum(map(mul, g, reversed(g)), ZERO)
        g.append((sign * square + (1 if len(g) == 1 else 0)) / len(g))
    return g


#: Errors beyond which lines may be better than series.
_LARGE = 0.01
_TANH_BEND = 2 / (3 * arb(3).sqrt()) * UNIT  # what tanh''/2 ranges over


def tanh(z: Model) -> Model:
    """Return the hyperbolic tangent: by its series, or by lines where errors are large."""

    def taylor(y: arb, n: int) -> list[arb]:
        h = y.tanh()
        slope = (1 - h * h).intersection(SHARE)
        return _riccati([h, slope, (-h * slope).intersection(_TANH_BEND)], -1, n)

    series = _apply(z, taylor)
    if not magnitude(z[TERMS:]) > _LARGE:
        return series
    line = tanh_line(z)
    return series if abs(series[-1]).upper() <= abs(line[-1]).upper() else line


def tanh_line(z: Model) -> Model:
    """Return tanh(z) as k z and what lies between, for the slope k of tanh at any place c >= 0.

    d(z) = tanh(z) - k z is odd, concave above 0 with its maximum at c, and convex below.
    """
    y = bound(z)
    low, high = y.lower(), y.upper()
    chord = float(((high.tanh() - low.tanh()) / (high - low)).mid())
    c = atanh(min(max(1 - chord, 0.0), 1 - 1e-9) ** 0.5)
    if low > 0 or high < 0:  # as steep as the chord between low and high, not beyond them
        middle, quarter = float(abs(y.mid())), float((high - low).mid()) / 4
        c = max(min(c, middle + quarter), middle - quarter)
    place = arb(max(c, 0.0))
    slope = 1 - place.tanh() ** 2
    first, last, top = (x.tanh() - slope * x for x in (low, high, place))
    most = first.max(top if high >= 0 else last)
    least = last.min(-top if low <= 0 else first)
    return plus(scale(z, slope), least.union(most))


def sigmoid(z: Model) -> Model:
    """Return 1 / (1 + exp(-z)) = (1 + tanh(z / 2)) / 2."""
    return plus(scale(tanh(scale(z, HALF)), HALF), HALF)


def maximum(z: Model, w: Model) -> Model:
    """Return max(z, w): where it is open which is larger, a mean of both and what that may lack."""
    y = bound(subtract(w, z))
    if y >= 0:
        return w
    if y <= 0:
        return z
    low, high = -y.lower(), y.upper()
    share = arb(float((high / (low + high)).mid()))
    # max(y, 0) - share y is convex, 0 at 0, and so at most its larger end value.
    most = (share * low).max((1 - share) * high).upper()
    return plus(add(scale(z, 1 - share), scale(w, share)), most * SHARE)


def minimum(z: Model, w: Model) -> Model:
    """Return min(z, w)."""
    return negative(maximum(negative(z), negative(w)))


def relu(z: Model) -> Model:
    """Return max(z, 0)."""
    return maximum(constant(ZERO, symbols(z)), z)


def _over_factorials(cycle: list[arb], n: int) -> list[arb]:
    return [cycle[k % 4] / factorial(k) for k in range(n + 1)]


def sine(z: Model) -> Model:
    """Return the sine."""

    def taylor(y: arb, n: int) -> list[arb]:
        s, c = y.sin_cos()
        return _over_factorials([s, c, -s, -c], n)

    return _apply(z, taylor)


def cosine(z: Model) -> Model:
    """Return the cosine."""

    def taylor(y: arb, n: int) -> list[arb]:
        s, c = y.sin_cos()
        return _over_factorials([c, -s, -c, s], n)

    return _apply(z, taylor)


def reciprocal(z: Model) -> Model:
    """Return 1 / z; ArithmeticError if z may be 0."""

    def taylor(y: arb, n: int) -> list[arb]:
        over = 1 / y
        return [over * (-over) ** k for k in range(n + 1)]

    return _apply(z, taylor)


def inverse_from(z: Model, least: arb) -> Model:
    """Return 1 / u, where u is a value of z of at least ``least`` (> 0): a series or a line.

    On [a, b], 1 / u + k u with k = 1 / (a b) is convex, at least 2 sqrt(k), and largest at an end.
    """
    y = bound(z)
    a = y.lower().max(least)
    b = y.upper().max(a)
    k = 1 / (a * b)
    between = (2 * k.sqrt()).union((1 / a + k * a).max(1 / b + k * b))
    line = plus(scale(z, -k), between)
    try:
        series = reciprocal(z)
    except ArithmeticError:
        return line
    return series if abs(series[-1]).upper() <= abs(line[-1]).upper() else line


def tan(z: Model) -> Model:
    """Return the tangent; ArithmeticError if z may be a right angle."""
    return _apply(z, lambda y, n: _riccati([y.tan()], 1, n))


def cosine_of_slope(z: Model) -> Model:
    """Return the cosine of the angle with tangent z: (1 + z^2)^(-1/2)."""

    def taylor(y: arb, n: int) -> list[arb]:
        square = 1 + y * y
        g = [square.rsqrt()]
        for k in range(n):  # (1 + y^2) g' = -y g, its order k
            g.append(-((2 * k + 1) * y * g[k] + k * g[k - 1]) / ((k + 1) * square))
        return g

    return _apply(z, taylor)


_SINC = [arb((-1) ** (k // 2)) / factorial(k + 1) * (1 - k % 2) for k in range(13)]


def sinc(z: Model) -> Model:
    """Return sin(z) / z = 1 - z^2/6 + z^4/120 - ...; ArithmeticError unless |z| <= 1.

    The series alternates with falling terms: what is cut off is below its first term.
    """
    most = abs(bound(z)).upper()
    if not most <= 1:
        raise ArithmeticError("the car turns by more than 2 rad in a step")
    out = _apply(z, lambda y, n: shifted(_SINC[:12], y, ONE, n + 1)[: n + 1])
    return plus(out, abs(_SINC[12]) * most**12 * UNIT)


def restrict(z: Model, parameter: int, low: arb, high: arb) -> Model:
    """Return z on the part [low, high] of parameter 0, x, or j > 0, symbol e_j, as [-1, 1].

    Raises ValueError for products, which have no parts.
    """
    if low == -1 and high == 1:
        return z
    if symbols(z) >= KNOWN and BASE < parameter <= KNOWN:
        raise ValueError("a product of symbols is divided")
    p, a, b, rest = split(z)
    middle, half = (low + high) / 2, (high - low) / 2
    if parameter == 0:
        moved = [x + y * middle for x, y in zip(a, b, strict=True)]
        return [*shifted(p, middle, half, TERMS), *moved, *(y * half for y in b), rest]
    out, m, own = list(z), symbols(z), parameter - 1
    for order, first in enumerate((TERMS, TERMS + m)):
        out[order] += z[first + own] * middle
        for k, (i, j) in enumerate(PAIRS if m >= KNOWN else [], first + BASE):
            if i == j == own:  # 2 e^2 - 1 with e = middle + half e'
                out[order] += z[k] * (2 * middle * middle + half * half - 1)
                out[first + own] += z[k] * (4 * middle)
                out[k] = z[k] * half * half
            elif own in (i, j):
                out[first + i + j - own] += z[k] * middle
                out[k] = z[k] * half
        out[first + own] *= half
    return out


def at_end(z: Model, x: int) -> tuple[arb, arb]:
    """Return the value of the polynomial at x = -1 or 1, and how far errors may stray from it.

    Not as a ball: its radius would be rounded to 30 bits.
    """
    p, a, b, rest = split(z)
    middle = sum((c * x**k for k, c in enumerate(p)), ZERO)
    return middle, magnitude([s + x * t for s, t in zip(a, b, strict=True)]) + abs(rest).upper()


def positive(z: Model, depth: int = 40) -> bool:
    """Tell whether a model is proved to be positive for all its members (bisecting in x)."""
    if bound(z) > 0:
        return True
    p, a, b, rest = split(z)
    if depth == 0 or not p[0] - magnitude(a) - abs(rest) > 0:
        return False  # nor will it be by bisecting: it is not at x = 0
    slope = arb_poly(p).derivative()(UNIT) + magnitude(b) * UNIT
    if not slope.contains(0):
        return all(middle > stray for middle, stray in (at_end(z, -1), at_end(z, 1)))
    return all(positive(half, depth - 1) for half in halves(z))


def halves(z: Model) -> tuple[Model, Model]:
    """Return z for x in [-1, 0] and in [0, 1], each as [-1, 1]."""
    return restrict(z, 0, -ONE, ZERO), restrict(z, 0, ZERO, ONE)

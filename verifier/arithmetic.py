"""One Taylor model in a traced program, and the arithmetic of Taylor models.

Everything that is known about their rounding is here; verifier.models holds batches of them and
has kernels made of these functions. Each operation returns a model that contains the exact
result for all members of its arguments: what is cut off, and every rounding of its own, goes
into the radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

from verifier.compiled.trace import Trace, Value, where
from verifier.compiled.trace import total as summed
from verifier.rounding import TINY, UP, U, gamma

DEGREE = 5
TERMS = DEGREE + 1
#: In models of at least KNOWN symbols those from BASE on are products of the first ones:
#: 2 e_i^2 - 1 and e_i e_j, by PAIRS. Forgetting that is always sound.
BASE = 3
PAIRS = tuple((i, j) for i in range(BASE) for j in range(i, BASE))
KNOWN = BASE + len(PAIRS)


@dataclass(frozen=True, eq=False)
class Model:
    """A Taylor model: coefficients ``[TERMS + 2 m]`` as in ``verifier.models``, and radius."""

    c: list[Value]
    radius: Value

    @property
    def p(self) -> list[Value]:
        """The polynomial part's coefficients."""
        return self.c[:TERMS]

    @property
    def e(self) -> list[Value]:
        """The error symbols' coefficients, two each."""
        return self.c[TERMS:]

    @property
    def values(self) -> list[Value]:
        """Coefficients and radius in one list."""
        return [*self.c, self.radius]

    def __neg__(self) -> Model:
        return Model([-x for x in self.c], self.radius)

    def __add__(self, other: Model) -> Model:
        a, b = (self, other) if len(self.c) >= len(other.c) else (other, self)
        c = [x + y for x, y in zip(a.c, b.c, strict=False)] + a.c[len(b.c) :]
        return Model(c, (a.radius + b.radius + U * total_size(c)) * UP)

    def __sub__(self, other: Model) -> Model:
        return self + (-other)

    def __mul__(self, other: Model) -> Model:
        return multiply(self, other)

    def plus(self, constant: Value | float) -> Model:
        """Add a real number that is given exactly."""
        first = self.c[0] + constant
        return Model([first, *self.c[1:]], (self.radius + U * abs(first)) * UP)

    def times(self, factor: Value | float) -> Model:
        """Multiply by a real number that is given exactly."""
        c = [x * factor for x in self.c]
        size = abs(self.radius.trace.number(factor))
        radius = (self.radius * size + U * total_size(c)) * UP + TINY
        return Model(c, radius)

    def widen(self, amount: Value | float) -> Model:
        """Add an unknown of at most ``amount`` (>= 0)."""
        return Model(self.c, (self.radius + amount) * UP)


def read(trace: Trace, symbols: int, index: int | None = None) -> Model:
    """Add a model to a trace's parameters: two tables, coefficients and radius."""
    c = trace.table(TERMS + 2 * symbols, index)
    return Model(c, trace.column(index))


def read_joined(trace: Trace, symbols: int, count: int, index: int | None = None) -> list[Model]:
    """Add models to a trace's parameters that lie in one table, one after the other."""
    width = TERMS + 2 * symbols + 1
    values = trace.table(width * count, index)
    return [
        Model(values[i * width : (i + 1) * width - 1], values[(i + 1) * width - 1])
        for i in range(count)
    ]


def total_size(values: Sequence[Value]) -> Value:
    """Return the sum of absolute values (not rounded up)."""
    return summed([abs(x) for x in values])


def norm(model: Model) -> Value:
    """Return the sum of the absolute values of all coefficients (not rounded up)."""
    return total_size(model.c)


def spread(model: Model) -> Value:
    """Return an upper bound of all but the constant coefficient: how far values stray from it."""
    return (total_size(model.c[1:]) + model.radius) * UP


def error_spread(model: Model) -> Value:
    """Return an upper bound of the error symbols' part and the radius."""
    return (summed([abs(x) for x in model.e] + [model.radius])) * UP


def bounds(model: Model) -> tuple[Value, Value]:
    """Return lower and upper bounds of all members.

    Even powers lie in [0, 1], which makes this tighter than the sum of absolute values.
    """
    p = model.p
    odd, even = total_size(p[1::2]), p[2::2]
    rest = odd + error_spread(model) + TERMS * U * (abs(p[0]) + total_size(even) + odd)
    rest = rest * UP
    low = p[0] + summed([where(x < 0.0, x, 0.0) for x in even]) - rest
    high = p[0] + summed([where(x > 0.0, x, 0.0) for x in even]) + rest
    # The last two sums round once more each.
    slack = 4 * U * (abs(low) + abs(high))
    return low - slack, high + slack


def multiply(a: Model, b: Model) -> Model:
    """Return the product."""
    pa, pb, ea, eb = a.p, b.p, a.e, b.e
    if len(ea) < len(eb):
        return multiply(b, a)
    c = [summed([pa[i] * pb[k - i] for i in range(k + 1)]) for k in range(TERMS)]
    # behind[k]: the sum of |p[i]| for i >= k.
    behind_a, behind_b = _behind(pa), _behind(pb)
    size_ea, size_eb = total_size(ea), total_size(eb)
    cut = summed([abs(pa[i]) * behind_b[TERMS - i] for i in range(1, TERMS)])
    for j, x in enumerate(ea):
        term = pb[0] * x if j % 2 == 0 else pb[0] * x + pb[1] * ea[j - 1]
        if j < len(eb):
            y = eb[j]
            other = pa[0] * y if j % 2 == 0 else pa[0] * y + pa[1] * eb[j - 1]
            term = term + other
        c.append(term)
    if ea:
        cut = cut + (abs(pb[1]) * total_size(ea[1::2]) + behind_b[2] * size_ea)
    if eb:
        cut = cut + (abs(pa[1]) * total_size(eb[1::2]) + behind_a[2] * size_eb)
        if len(ea) >= 2 * KNOWN and len(eb) >= 2 * BASE:
            (line_a, rest_a), (line_b, rest_b) = based(ea), based(eb)
            add_products(c, line_a, line_b)
            cut = cut + (rest_a * size_eb + total_size(line_a) * rest_b)
        else:
            cut = cut + size_ea * size_eb
    size_a, size_b = behind_a[0] + size_ea, behind_b[0] + size_eb
    # A coefficient is a sum of at most TERMS + 6 products.
    radius = cut + a.radius * (size_b + b.radius) + b.radius * size_a
    radius = radius + gamma(TERMS + 8) * (size_a * size_b)
    return Model(c, radius * UP + TINY)


def based(e: list[Value]) -> tuple[list[Value], Value]:
    """Return the a_j of the first BASE of some symbols, and the size of all other coefficients."""
    return e[: 2 * BASE : 2], total_size(e[1 : 2 * BASE : 2] + e[2 * BASE :])


def add_products(c: list[Value], a: Sequence[Value], b: Sequence[Value]) -> None:
    """Add the product of sum_j a_j e_j and sum_j b_j e_j, j < BASE, to coefficients."""
    for k, (i, j) in enumerate(PAIRS, BASE):
        if i == j:  # e^2 = (1 + (2 e^2 - 1)) / 2
            term = 0.5 * (a[i] * b[i])
            c[0] = c[0] + term
        else:
            term = a[i] * b[j] + a[j] * b[i]
        c[TERMS + 2 * k] = c[TERMS + 2 * k] + term


def substitute(model: Model, middle: Value, half: Value) -> Model:
    """Return the model in x' where x = middle + half x', |middle| + half <= 1 up to rounding."""
    p, e = model.p, model.e
    powers_m, powers_h = [_one(middle)], [_one(half)]
    for _ in range(1, TERMS):
        powers_m.append(powers_m[-1] * middle)
        powers_h.append(powers_h[-1] * half)
    c = [
        summed([comb(j, i) * (p[j] * (powers_m[j - i] * powers_h[i])) for j in range(i, TERMS)])
        for i in range(TERMS)
    ]
    for j in range(0, len(e), 2):
        c += [e[j] + e[j + 1] * middle, e[j + 1] * half]
    # No intermediate result exceeds 2^5 norms.
    radius = model.radius + gamma(4 * TERMS) * 2.0**TERMS * norm(model)
    return Model(c, radius * UP + TINY)


def _one(like: Value) -> Value:
    return like.trace.number(1.0)


def _behind(p: list[Value]) -> list[Value]:
    found = [abs(p[-1])]
    for x in reversed(p[:-1]):
        found.append(found[-1] + abs(x))
    return found[::-1]


def unless(condition: Value, model: Model) -> Model:
    """Return the model; of infinite radius where the condition does not hold."""
    return Model(model.c, where(condition, model.radius, float("inf")))

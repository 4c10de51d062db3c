"""Whether a row contains given models: a part of its parent, the image of a step, another row."""

from __future__ import annotations

from itertools import product

from flint import arb, arb_mat

from checker.files import NAMES, Row, require
from checker.models import TERMS, UNIT, ZERO, Model, at_end, magnitude, restrict, symbols

#: Directions of a set: name, constant part and part that goes with x, of s, f, v, theta.
Columns = list[tuple[str, list[arb], list[arb]]]
#: A part of the domain: one after the other, a parameter (0: x; j: symbol e_j-1) is kept to a
#: part [low, high] of its range, which is then [-1, 1].
Cuts = tuple[tuple[int, arb, arb], ...]


def models_of(row: Row, apart: bool = False) -> list[Model]:
    """Return the models of a row without rests, or with each rest as a symbol more.

    Rests are symbols where they must not be rounded up: a ball's radius has 30 bits.
    """
    out = []
    for k, (c, e) in enumerate(zip(row.centre.tolist(), row.spread, strict=True)):
        own = [arb(float(row.radius[k])) if i == k else ZERO for i in range(4)] if apart else []
        a, b = (list(map(arb, column)) for column in e.T.tolist())
        out.append([*map(arb, c), *a, *own, *b, *[ZERO] * len(own), ZERO])
    return out


def state_of(row: Row) -> list[Model]:
    """Return the models of a row."""
    rests = [arb(x) * UNIT for x in row.radius.tolist()]
    return [[*z[:-1], rest] for z, rest in zip(models_of(row), rests, strict=True)]


def restricted(state: list[Model], cuts: Cuts) -> list[Model]:
    """Return models on a part of the domain of x and e."""
    for cut in cuts:
        state = [restrict(z, *cut) for z in state]
    return state


def prove_part(inner: list[Model], row: Row) -> None:
    """Prove that a row contains models in the same x and e (inner may have more symbols)."""
    _prove(_less(inner, models_of(row), TERMS, len(row.spread[0])), [], row)


def prove_image(inner: list[Model], row: Row, carried: int, cuts: Cuts = ()) -> None:
    """Prove that a row contains models in the same x, its first ``carried`` symbols the same.

    cuts: on which part of their x and symbols the models are; of these the row has only x and
    those that are the same.
    """
    outer = restricted(models_of(row), tuple(cut for cut in cuts if cut[0] <= carried))
    _prove(_less(inner, outer, TERMS, carried), _columns(outer, carried), row)


def prove_gathered(inner: list[Model], row: Row) -> None:
    """Prove that a row, constant but for its own x and e in first order, contains models."""
    require(not (row.centre[:, 2:].any() or row.spread[:, :, 1].any()), "it is not gathered: bent")
    x = "x", [arb(c) for c in row.centre[:, 1].tolist()], [ZERO] * 4
    outer = models_of(row)
    _prove(_less(inner, outer, 1, 0), [x, *_columns(outer, 0)], row)


def _columns(outer: list[Model], first: int) -> Columns:
    m = symbols(outer[0])
    return [
        (f"symbol {j}", [z[TERMS + j] for z in outer], [z[TERMS + m + j] for z in outer])
        for j in range(first, m)
    ]


def _less(inner: list[Model], outer: list[Model], orders: int, same: int) -> list[Model]:
    """Return models less those of a row, of which so many orders and symbols count."""
    out = [list(z) for z in inner]
    for d, z in zip(out, outer, strict=True):
        for k in range(orders):
            d[k] -= z[k]
        for j in range(TERMS, TERMS + same):
            d[j] -= z[j]
            d[j + symbols(d)] -= z[j + symbols(z)]
    return out


def _prove(d: list[Model], columns: Columns, row: Row) -> None:
    """Prove d = M(x) e' + rest' with |e'_j| <= 1 and |rest'| <= radius; Rejected if that fails.

    M(x) = A + B x are the columns. With y = W d, W nearly an inverse of A, and
    e'_j = y_j / (1 + s_j x), with any numbers s_j,

        d - M(x) e' = (d - A y) + x sum_j e'_j (s_j A_j - B_j),

    and |e'_j| <= 1 if |y_j| <= 1 + s_j x. Bounds of |y_j| are convex in x, so that x = -1 and 1
    suffice; x^2 and x^4 are in [0, 1]. What room the radius leaves takes up a part of d's rest.
    """
    columns = [column for column in columns if any(x != 0 for x in column[1])]
    a, b = _matrix([c[1] for c in columns]), _matrix([c[2] for c in columns])
    w = _inverse(a)
    slopes = [arb(float((w * b)[k, k].mid())) for k in range(len(columns))]
    # (1 - A W) d, not d - A y: balls do not cancel.
    left = ((arb_mat(4, 4, 1) - a * w) * arb_mat(d)).tolist()
    for i, (name, size) in enumerate(zip(NAMES, row.radius.tolist(), strict=True)):
        turned = [s * a[i, k] - b[i, k] for k, s in enumerate(slopes)]
        room = (arb(size) - magnitude(left[i]) - magnitude(turned)).lower()
        require(room >= 0, f"the rest of {name} sticks out by {_text(-room)}")
        d[i][-1] = (d[i][-1].rad() - room).upper().max(ZERO) * UNIT
    for (name, *_), slope, y in zip(columns, slopes, (w * arb_mat(d)).tolist(), strict=True):
        odd, even = magnitude(y[3:TERMS:2]), y[2:TERMS:2]
        for x, sign in product((-1, 1), (-1, 1)):
            middle, stray = at_end([*y[:2], *[ZERO] * (TERMS - 2), *y[TERMS:]], x)
            most = sign * middle + stray + odd + sum(((sign * c).max(ZERO) for c in even), ZERO)
            short = most - (1 + slope * x)
            require(short <= 0, f"it sticks out of {name} by {_text(short)}")


def _matrix(columns: list[list[arb]]) -> arb_mat:
    return arb_mat(len(columns), 4, [x for column in columns for x in column]).transpose()


def _inverse(a: arb_mat) -> arb_mat:
    """Return a matrix near the (pseudo)inverse of one of independent columns; any will do."""
    n = a.ncols()
    sizes = [1 / magnitude(column).mid() for column in a.transpose().tolist()]
    scale = arb_mat(n, n, [sizes[i] if i == j else ZERO for i in range(n) for j in range(n)])
    flat = scale * a.transpose()
    try:
        return (scale * (flat * flat.transpose()).solve(flat)).mid()
    except ZeroDivisionError:
        return flat * 0


def _text(value: arb) -> str:
    return f"{float(value.mid()):.3g}"

"""Elements of tensors: models with what more is known of their values.

Beside a wall's end a graph divides by what is nearly 0, and takes the lesser of the quotient and of
another number: a model of the quotient is useless, but that it is large is enough. So an interval
is kept beside some models, and of a quotient what was divided by what.
"""

from __future__ import annotations

from flint import arb

from checker import models
from checker.models import HALF, UNIT, Model, bound, plus, scale

_FAR = arb("inf")


class Known(list[arb]):
    """A model, an interval that holds its values, and of a quotient its parts."""

    def __init__(
        self,
        model: Model,
        low: arb,
        high: arb,
        above: Model | None = None,
        below: Model | None = None,
    ) -> None:
        first, last = interval(model)
        low, high = first.max(low), last.min(high)
        if not low <= high:  # not a number, or no value at all
            low, high = -_FAR, _FAR
        wide = last - first
        if (low.is_finite() and high.is_finite()) and not high - low >= HALF * wide:
            model = models.constant(low.union(high), models.symbols(model))
        super().__init__(model)
        self.low, self.high, self.above, self.below = low, high, above, below


def interval(z: Model) -> tuple[arb, arb]:
    """Return bounds of the values of a model, infinite where nothing is known."""
    if isinstance(z, Known):
        return z.low, z.high
    y = bound(z)
    return (y.lower(), y.upper()) if y.is_finite() else (-_FAR, _FAR)


def is_number(z: Model) -> bool:
    """Tell whether a model is one number."""
    return all(x == 0 for x in z[1:])


def negative(z: Model) -> Model:
    """Return -z."""
    turned = models.negative(z)
    return Known(turned, -z.high, -z.low) if isinstance(z, Known) else turned


def maximum(z: Model, w: Model) -> Model:
    """Return max(z, w)."""
    (zl, zh), (wl, wh) = interval(z), interval(w)
    if zh <= wl:
        return w
    if wh <= zl:
        return z
    return Known(models.maximum(z, w), zl.max(wl), zh.max(wh))


def minimum(z: Model, w: Model) -> Model:
    """Return min(z, w)."""
    (zl, zh), (wl, wh) = interval(z), interval(w)
    if zh <= wl:
        return z
    if wh <= zl:
        return w
    return Known(models.minimum(z, w), zl.min(wl), zh.min(wh))


def product(z: Model, w: Model) -> Model:
    """Return z w."""
    if is_number(w):
        return scale(z, w[0])
    return scale(w, z[0]) if is_number(z) else models.multiply(z, w)


def quotient(z: Model, w: Model, inverse: Model) -> Model:
    """Return z / w, ``inverse`` being 1 / w."""
    if is_number(w):
        return scale(z, 1 / w[0])
    return Known(product(z, inverse), *divided(interval(z), interval(w)), above=z, below=w)


def divided(z: tuple[arb, arb], w: tuple[arb, arb]) -> tuple[arb, arb]:
    """Return bounds of z / w, infinite where w may be 0."""
    if w[1] < 0:
        z, w = (-z[1], -z[0]), (-w[1], -w[0])
    if not w[0] > 0:
        return -_FAR, _FAR
    low = z[0] / (w[1] if z[0] >= 0 else w[0])
    high = z[1] / (w[0] if z[1] >= 0 else w[1])
    finite = low.is_finite() and high.is_finite()
    return (low.lower(), high.upper()) if finite else (-_FAR, _FAR)


def reciprocal(z: Model) -> Model:
    """Return 1 / z; ArithmeticError unless z is known not to be 0."""
    if is_number(z):
        return models.constant(1 / z[0], models.symbols(z))
    low, high = interval(z)
    if isinstance(z, Known) and low > 0:
        return models.inverse_from(list(z), low)
    if isinstance(z, Known) and high < 0:
        return models.negative(models.inverse_from(models.negative(z), -high))
    return models.reciprocal(z)


def tanh(z: Model) -> Model:
    """Return the hyperbolic tangent, by lines where its series does not converge."""
    try:
        return models.tanh(z)
    except ArithmeticError:
        return models.tanh_line(z)


def sigmoid(z: Model) -> Model:
    """Return 1 / (1 + exp(-z)) = (1 + tanh(z / 2)) / 2."""
    return plus(scale(tanh(scale(z, HALF)), HALF), HALF)


def greater(z: Model, w: Model) -> bool | None:
    """Tell whether z > w for all values; None if that is open."""
    (zl, zh), (wl, wh) = interval(z), interval(w)
    if zl > wh:
        return True
    if zh <= wl:
        return False
    y = models.subtract(z, w)
    if models.positive(y):
        return True
    return False if models.positive(models.negative(y)) else None


def at_least(z: Model, w: Model) -> bool | None:
    """Tell whether z >= w for all values; None if that is open."""
    less = greater(w, z)
    return None if less is None else not less


def chosen(condition: bool | None, z: Model, w: Model) -> Model:
    """Return z or w; where it is open which, their mean and half of how far they are apart."""
    if isinstance(condition, bool):
        return z if condition else w
    if condition is not None:
        raise TypeError("Where is not of a comparison")
    (zl, zh), (wl, wh) = interval(z), interval(w)
    apart = abs(bound(models.subtract(z, w))).upper()
    mean = scale(models.add(z, w), HALF)
    return Known([*mean[:-1], mean[-1] + apart * HALF * UNIT], zl.min(wl), zh.max(wh))

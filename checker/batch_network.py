"""The network on the Taylor models of many scans at once: see ``checker.batch``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from checker import balls
from checker.balls import Balls, add, between, exact, from_zero, multiply, raised, subtract, times
from checker.batch import (
    apply,
    by_entry,
    chosen,
    parts,
    plus,
    range_of,
    riccati,
    scaled,
    settled,
    stray,
)
from checker.files import Layer
from checker.models import Model

_BEND = 0.384900179459751  # more than 2 / (3 sqrt(3)), the largest |tanh''| / 2
#: Numbers in an array; of more, arrays do not fit the caches. Of fewer scans, calls cost more.
_AT_ONCE, _LEAST = 1 << 16, 8
_LARGE = 0.01  # errors beyond which lines may be better than series


class BatchNetwork:
    """The real-valued function of the float32 weights, for many scans at once."""

    def __init__(self, layers: list[Layer]) -> None:
        self._layers = [
            (x.weights.astype(float), x.biases.astype(float), x.activation) for x in layers
        ]
        self._width = max(len(x.weights) for x in layers)

    def at_once(self, entries: int) -> int:
        """Return how many scans of so many entries it follows best together."""
        return max(_LEAST, _AT_ONCE // (self._width * entries))

    def steering(self, scans: Sequence[Balls]) -> list[Model | None]:
        """Return the steering (rad) for each scan (m), None where it has no bounds.

        scans: settled models ``[rays, entries]``, of the same symbols; best ``at_once`` of them.
        """
        z = by_entry(Balls(*map(np.array, zip(*scans, strict=True))))
        with np.errstate(all="ignore"):
            for weights, biases, activation in self._layers:
                z = _affine(weights, biases, z)
                z = settled(_ACTIVATIONS[activation](z)) if activation else z
        known = np.isfinite(z.middle + z.radius).all(axis=(1, 2))
        return [balls.to_arb(z.at(k, 0)) if known[k] else None for k in range(len(scans))]


def _affine(weights: NDArray, biases: NDArray, z: Balls) -> Balls:
    """Return weights z + biases, settled, for settled models by entry.

    The errors of all entries are in one sum, as in ``balls.product`` those of each.
    """
    middle = np.moveaxis(z.middle, -1, 0) @ weights.T
    first = add(exact(middle[0]), exact(biases))
    middle[0] = first.middle
    n = sum(weights.shape) + z.middle.shape[-1]  # more than the terms of any sum
    share = (n + 8) * balls.U * (1 + 2.0**-20)
    sizes = z.radius[..., -1] + share * np.abs(z.middle).sum(-1)
    radius = np.zeros_like(middle)
    radius[-1] = (sizes @ np.abs(weights).T + first.radius) * (1 + 2 * share) + balls.TINY
    return Balls(np.moveaxis(middle, 0, -1), np.moveaxis(radius, 0, -1))


# --- activations ------------------------------------------------------------------------------


def _tanh_taylor(y: Balls, n: int) -> list[Balls]:
    """Return the Taylor coefficients of tanh: g' = 1 - g^2."""
    wide = bool(y.radius.any())
    h = balls.tanh_between(y) if wide else balls.tanh(y.middle)
    one = exact(np.ones_like(h.middle))
    slope = subtract(one, multiply(h, h))
    slope = balls.clip(slope, 0, 1) if wide else slope
    bend = multiply(Balls(-h.middle, h.radius), slope)
    return riccati([h, slope, balls.clip(bend, -_BEND, _BEND) if wide else bend], -1, n)


def _tanh(z: Balls) -> Balls:
    """Return the hyperbolic tangents: by their series, or by lines where errors are large."""
    series = apply(z, _tanh_taylor)
    large = stray(z) > _LARGE
    if not large.any():
        return series
    line = _tanh_line(z)
    better = large & (line.radius[..., -1] < series.radius[..., -1])
    return chosen(better[..., None], line, series)


def _tanh_line(z: Balls) -> Balls:
    """Return tanh(z) as k z and what lies between: see models._tanh_line."""
    y = range_of(z)
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
    return scaled(z, slope, between(least, most))


def _sigmoid(z: Balls) -> Balls:
    """Return (1 + tanh(z / 2)) / 2."""
    half = settled(times(_tanh(settled(times(z, 0.5))), 0.5))
    p, a, b, rest = parts(half)
    return plus([*p, a, b], Balls(np.full_like(rest, 0.5), rest))


def _relu(z: Balls) -> Balls:
    """Return max(z, 0): where its sign is open, a share of z and what that may lack."""
    y = range_of(z)
    low, high = balls.lower(y), balls.upper(y)
    share = np.where(low >= 0, 1.0, np.where(high <= 0, 0.0, high / (high - low)))
    # max(y, 0) - share y is convex, 0 at 0, and so at most its larger end value.
    most = np.maximum(raised(share * -low), raised(raised(1 - share) * high))
    most = np.where((low >= 0) | (high <= 0), 0.0, most)
    return scaled(z, exact(share), from_zero(most))


_ACTIVATIONS = {"Tanh": _tanh, "Sigmoid": _sigmoid, "Relu": _relu}

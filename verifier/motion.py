"""One control step of the car on Taylor models: the exact arc of racecar.bicycle."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from racecar.bicycle import Bicycle
from verifier.elementary import exp_negative
from verifier.functions import sine_cosine, tan
from verifier.models import TERMS, Array, Models, error_spread, norm, stack
from verifier.rounding import UP, U
from verifier.rows import THETA, F, S, V


@dataclass(frozen=True)
class Path:
    """One step: start and end ``[4, rows]``, curvature and distance of the arc ``[rows]``.

    slip: cosine and sine of the slip angle beta ``[2, rows]``, or None where beta is 0.
    """

    start: Models
    curvature: Models
    distance: Models
    state: Models
    slip: Models | None

    def take(self, index: NDArray[np.intp]) -> Path:
        """Return the paths of the rows at ``index``."""
        return Path(
            self.start[:, index],
            self.curvature[index],
            self.distance[index],
            self.state[:, index],
            None if self.slip is None else self.slip[:, index],
        )

    def point(self, share: float) -> Models:
        """Return s and f ``[2, rows]`` after a share (a power of 2 or its multiple) of the arc.

        chord = distance sinc(turned / 2), in the direction theta + beta + turned / 2.
        """
        distance = self.distance.times(share)
        half = (self.curvature * distance).times(0.5)
        chord = distance * sinc(half)
        sine, cosine = sine_cosine(self.start[THETA] + half)
        if self.slip is not None:
            sine, cosine = (
                sine * self.slip[0] + cosine * self.slip[1],
                cosine * self.slip[0] - sine * self.slip[1],
            )
        return stack([self.start[S] - chord * sine, self.start[F] - chord * cosine])


class Motion:
    """The car's motion over one control period."""

    def __init__(self, bicycle: Bicycle, period: float) -> None:
        self._top = _Real(bicycle.motor) * (_Real(bicycle.throttle) - _Real(bicycle.hysteresis))
        exponent = -bicycle.acceleration * period
        # The exponent is rounded: exp changes by at most as much, as exp <= 1 there.
        decay = float(exp_negative(np.array([exponent]))[0])
        self._decay = _Real(decay, 16 * U * decay + 2 * U * abs(exponent))
        self._gone = (_Real(1.0) - self._decay) * _inverse(bicycle.acceleration)
        self._coast = self._top * (_Real(period) - self._gone)
        self._inverse_base = _inverse_sum(bicycle.front, bicycle.rear)
        self._rear_share = _Real(bicycle.rear) * self._inverse_base if bicycle.slip else None

    def drive(self, state: Models, steering: Models) -> Path:
        """Return the path of one period from ``state`` (models ``[4, rows]``)."""
        speed = state[V]
        distance = scaled(speed, self._gone).plus(self._coast.value).widen(self._coast.error)
        slower = scaled(speed, self._decay)
        rise = self._top * (_Real(1.0) - self._decay)
        after = slower.plus(rise.value).widen(rise.error)
        slope = tan(steering)
        curvature, slip = scaled(slope, self._inverse_base), None
        if self._rear_share is not None:
            slip = _slip(scaled(slope, self._rear_share))
            curvature = curvature * slip[0]
        path = Path(state, curvature, distance, state, slip)
        position, theta = path.point(1.0), state[THETA] + curvature * distance
        return replace(path, state=stack([position[0], position[1], after, theta]))


def _slip(tangent: Models) -> Models:
    """Return cosine and sine ``[2, rows]`` of the angle in (-90, 90) degrees with this tangent.

    cos = (1 + w)^(-1/2) with w = tangent^2 by its binomial series, which alternates with
    falling terms for w <= 1/4: the rest is below the first term cut off.
    """
    square = tangent * tangent
    most = (norm(square.c) + square.radius) * UP
    terms = [1.0]
    for k in range(1, 14):
        terms.append(-terms[-1] * (2 * k - 1) / (2 * k))
    total = square.times(terms[12])
    for term in terms[11:0:-1]:
        total = total.plus(term) * square
    total = total.plus(1.0).widen(abs(terms[13]) * most**13 * UP + 64 * U * most)
    cosine = Models(total.c, np.where(most <= 0.25, total.radius, np.inf))
    return stack([cosine, cosine * tangent])


@dataclass(frozen=True)
class _Real:
    """A real number known to within ``error`` of ``value``."""

    value: float
    error: float = 0.0

    def __mul__(self, other: _Real) -> _Real:
        value = self.value * other.value
        error = self.error * (abs(other.value) + other.error) + other.error * abs(self.value)
        return _Real(value, (error + U * abs(value)) * UP)

    def __sub__(self, other: _Real) -> _Real:
        value = self.value - other.value
        return _Real(value, (self.error + other.error + U * abs(value)) * UP)


def _inverse(x: float) -> _Real:
    return _Real(1 / x, 2 * U / abs(x))


def _inverse_sum(a: float, b: float) -> _Real:
    return _Real(1 / (a + b), 4 * U / (a + b))


def scaled(models: Models, factor: _Real) -> Models:
    """Return models times a real number that is not known exactly."""
    size = norm(models.c) + models.radius
    return models.times(factor.value).widen(size * factor.error * UP)


def sinc(x: Models) -> Models:
    """Return sin(x) / x = 1 - x^2/6 + x^4/120 - ...; infinite radius unless |x| <= 1.

    The series alternates with falling terms there: the rest is below the first term cut off.
    """
    square = x * x
    most = (norm(square.c) + square.radius) * UP
    terms = [(-1) ** k / math.factorial(2 * k + 1) for k in range(5)]
    total = square.times(terms[4])
    for term in (terms[3], terms[2], terms[1]):
        total = (total.plus(term)) * square
    # The coefficients are rounded by less than U relative.
    rest = most**5 / math.factorial(11) + 4 * U * most
    total = total.plus(1.0).widen(rest * UP)
    return Models(total.c, np.where(most <= 1, total.radius, np.inf))


def new_error(state: Models) -> Array:
    """Return the largest radius of each row: what the last step added."""
    return state.radius.max(axis=0)


def total_error(state: Models) -> Array:
    """Return the largest error (symbols and radius) of each row."""
    return error_spread(state).max(axis=0)


def extent(state: Models) -> Array:
    """Return how far the polynomial part of s and f strays from its middle, per row (m)."""
    return norm(state.c[1:TERMS, S : F + 1]).max(axis=0)

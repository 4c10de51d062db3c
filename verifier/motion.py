"""One control step of the car on Taylor models: the exact arc of racecar.bicycle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from racecar.bicycle import Bicycle
from verifier.arithmetic import Model, norm, read, unless
from verifier.compiled.kernel import kernel
from verifier.compiled.trace import Trace, Value
from verifier.elementary import exp_negative
from verifier.functions import sine_cosine, tan
from verifier.models import TERMS, Array, Models, error_spread, lifted, padded, stack
from verifier.models import norm as norm_of
from verifier.rounding import UP, U
from verifier.rows import THETA, F, S, V
from verifier.walls import grid


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
        """Return s and f ``[2, rows]`` after a share (a power of 2 or its multiple) of the arc."""
        return self.points([share])[:, 0]

    def points(self, shares: Sequence[float]) -> Models:
        """Return s and f ``[2, shares, rows]`` after shares, multiples of a power of 2."""
        rows, m = self.curvature.radius.shape[0], self.curvature.symbols
        share, row = grid(len(shares), rows)
        tables = [
            table
            for models in (
                *(self.start[i] for i in (S, F, THETA)),
                self.curvature,
                self.distance,
                *(() if self.slip is None else (self.slip[0], self.slip[1])),
            )
            for table in (models.c, models.radius[None])
        ]
        program = _point(m, self.slip is not None)
        out = program(len(row), [*tables, np.array(shares, dtype=float)[None]], [row, share])
        width = TERMS + 2 * m
        both = out.reshape(2, width + 1, len(shares), rows)
        return Models(np.ascontiguousarray(both[:, :width].swapaxes(0, 1)), both[:, width])


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
        rise = self._top * (_Real(1.0) - self._decay)
        reals = [self._gone, self._coast, self._decay, rise, self._inverse_base]
        reals += [self._rear_share] if self._rear_share else []
        self._reals = np.array([[x for real in reals for x in (real.value, real.error)]]).T

    def drive(self, state: Models, steering: Models) -> Path:
        """Return the path of one period from ``state`` (models ``[4, rows]``)."""
        rows = steering.radius.shape[0]
        slip = self._rear_share is not None
        symbols = max(state.symbols, steering.symbols)
        state, steering = padded(state, symbols), padded(steering, symbols)
        tables = [
            table
            for models in (state[V], state[THETA], steering)
            for table in (models.c, models.radius[None])
        ]
        program = _turn(symbols, slip)
        out = program(rows, [*tables, self._reals], [np.zeros(rows, dtype=np.intp)])
        width = TERMS + 2 * symbols
        found = out.reshape(-1, width + 1, rows)
        curvature, distance, speed, theta = (Models(x[:-1], x[-1]) for x in found[:4])
        beta = stack([Models(x[:-1], x[-1]) for x in found[4:]]) if slip else None
        path = Path(state, curvature, distance, state, beta)
        position = path.points([1.0])
        c, radius = np.empty((width, 4, rows)), np.empty((4, rows))
        c[:, S : F + 1], radius[S : F + 1] = position.c[:, :, 0], position.radius[:, 0]
        for i, models in ((V, speed), (THETA, theta)):
            c[:, i], radius[i] = models.c, models.radius
        return replace(path, state=Models(c, radius))


@kernel
def _turn(trace: Trace, symbols: int, slip: bool) -> list[Value]:
    """Curvature, distance, speed and heading after a period, cosine and sine of the slip angle."""
    speed, theta, steering = (read(trace, symbols) for _ in range(3))
    numbers = trace.table(12 if slip else 10, trace.index())
    reals = [_Known(*numbers[i : i + 2]) for i in range(0, len(numbers), 2)]
    gone, coast, decay, rise, inverse_base = reals[:5]
    distance = scaled(speed, gone).plus(coast.value).widen(coast.error)
    after = scaled(speed, decay).plus(rise.value).widen(rise.error)
    slope = tan(steering)
    curvature = scaled(slope, inverse_base)
    beta: list[Value] = []
    if slip:
        cosine, sine = slip_pair(scaled(slope, reals[5]))
        curvature = curvature * cosine
        beta = [*cosine.values, *sine.values]
    heading = theta + curvature * distance
    return [*curvature.values, *distance.values, *after.values, *heading.values, *beta]


@kernel
def _point(trace: Trace, symbols: int, slip: bool) -> list[Value]:
    """Position after a share of the arc.

    chord = distance sinc(turned / 2), in the direction theta + beta + turned / 2.
    """
    row, share = trace.index(), trace.index()
    start_s, start_f, theta, curvature, whole = (read(trace, symbols, row) for _ in range(5))
    beta = [read(trace, symbols, row) for _ in range(2)] if slip else []
    distance = whole.times(trace.column(share))
    half = (curvature * distance).times(0.5)
    chord = distance * sinc(half)
    sine, cosine = sine_cosine(theta + half)
    if beta:
        sine, cosine = (
            sine * beta[0] + cosine * beta[1],
            cosine * beta[0] - sine * beta[1],
        )
    return [*(start_s - chord * sine).values, *(start_f - chord * cosine).values]


@lifted
def slip_pair(tangent: Model) -> tuple[Model, Model]:
    """Return cosine and sine of the angle in (-90, 90) degrees with this tangent.

    cos = (1 + w)^(-1/2) with w = tangent^2 by its binomial series, which alternates with
    falling terms for w <= 1/4: the rest is below the first term cut off.
    """
    square = tangent * tangent
    most = (norm(square) + square.radius) * UP
    terms = [1.0]
    for k in range(1, 14):
        terms.append(-terms[-1] * (2 * k - 1) / (2 * k))
    total = square.times(terms[12])
    for term in terms[11:0:-1]:
        total = total.plus(term) * square
    power = most
    for _ in range(12):
        power = power * most
    total = total.plus(1.0).widen(abs(terms[13]) * power * UP + 64 * U * most)
    cosine = unless(most <= 0.25, total)
    return cosine, cosine * tangent


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


@dataclass(frozen=True)
class _Known:
    """A ``_Real`` in a traced program."""

    value: Value
    error: Value


def scaled(model: Model, factor: _Known) -> Model:
    """Return a model times a real number that is not known exactly."""
    size = norm(model) + model.radius
    return model.times(factor.value).widen(size * factor.error * UP)


@lifted
def sinc(x: Model) -> Model:
    """Return sin(x) / x = 1 - x^2/6 + x^4/120 - ...; infinite radius unless |x| <= 1.

    The series alternates with falling terms there: the rest is below the first term cut off.
    """
    square = x * x
    most = (norm(square) + square.radius) * UP
    terms = [(-1) ** k / math.factorial(2 * k + 1) for k in range(5)]
    total = square.times(terms[4])
    for term in (terms[3], terms[2], terms[1]):
        total = (total.plus(term)) * square
    # The coefficients are rounded by less than U relative.
    double = most * most
    rest = (double * double * most) * (1 / math.factorial(11)) + 4 * U * most
    return unless(most <= 1.0, total.plus(1.0).widen(rest * UP))


def new_error(state: Models) -> Array:
    """Return the largest radius of each row: what the last step added."""
    return state.radius.max(axis=0)


def total_error(state: Models) -> Array:
    """Return the largest error (symbols and radius) of each row."""
    return error_spread(state).max(axis=0)


def extent(state: Models) -> Array:
    """Return how far the polynomial part of s and f strays from its middle, per row (m)."""
    return norm_of(state.c[1:TERMS, S : F + 1]).max(axis=0)

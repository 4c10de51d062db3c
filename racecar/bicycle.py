"""The kinematic bicycle model: speed in closed form, every control step an exact arc.

Equations: Ivanov et al., HSCC 2020, section 3.1. With steering ``delta`` held constant
the speed does not depend on it, so the distance D driven in a step is known, and the
curvature ``kappa = cos(beta) tan(delta) / (l_f + l_r)`` is constant: the path is a
circular arc of length D. No ODE solver is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.errors import BadInput
from racecar.polygon import Array


@dataclass(frozen=True)
class Arc:
    """The path of one control step, a circular arc; all fields of one batch shape.

    s, f: where it starts, metres; course: direction of travel ``theta + beta`` at the
    start, radians; curvature: 1/m, left positive; distance: its length, metres.
    """

    s: Array
    f: Array
    course: Array
    curvature: Array
    distance: Array

    def point(self, distance: ArrayLike) -> tuple[Array, Array]:
        """Return (s, f) after ``distance`` metres (any shape that broadcasts)."""
        distance = np.asarray(distance, dtype=float)
        half = self.curvature * distance / 2
        chord, along = distance * _sinc(half), self.course + half
        return self.s - chord * np.sin(along), self.f - chord * np.cos(along)

    @cached_property
    def end(self) -> tuple[Array, Array]:
        """Where it ends: (s, f)."""
        return self.point(self.distance)

    def take(self, index: NDArray | slice) -> Arc:
        """Return the arcs at ``index``."""
        return Arc(
            self.s[index],
            self.f[index],
            self.course[index],
            self.curvature[index],
            self.distance[index],
        )


@dataclass(frozen=True)
class Bicycle:
    """Parameters of the car; the defaults are the paper's.

    throttle: u, constant; acceleration, motor, hysteresis: c_a (1/s), c_m, c_h;
    front, rear: l_f and l_r, metres; slip: whether the slip angle beta is modelled
    (the benchmark sets it to 0).
    """

    throttle: float = 16.0
    acceleration: float = 1.633
    motor: float = 0.2
    hysteresis: float = 4.0
    front: float = 0.225
    rear: float = 0.225
    slip: bool = False

    def __post_init__(self) -> None:
        for name in ("acceleration", "motor", "front", "rear"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise BadInput(f"bicycle: {name} is {value}; it must be a positive number")
        if not (math.isfinite(self.throttle) and math.isfinite(self.hysteresis)):
            raise BadInput("bicycle: throttle and hysteresis must be finite")
        if self.throttle < self.hysteresis:
            raise BadInput("bicycle: throttle is below hysteresis; the car would drive backwards")

    @property
    def top_speed(self) -> float:
        """The speed (m/s) that the car tends to."""
        return self.motor * (self.throttle - self.hysteresis)

    def speed_after(self, v: ArrayLike, time: ArrayLike) -> Array:
        """Return the speed (m/s) after ``time`` seconds, from speed ``v``."""
        return self.top_speed + (np.asarray(v) - self.top_speed) * np.exp(
            -self.acceleration * np.asarray(time)
        )

    def distance_after(self, v: ArrayLike, time: ArrayLike) -> Array:
        """Return the distance (m) driven in ``time`` seconds, from speed ``v``."""
        decay = -np.expm1(-self.acceleration * np.asarray(time)) / self.acceleration
        return self.top_speed * np.asarray(time) + (np.asarray(v) - self.top_speed) * decay

    def arc(
        self, s: Array, f: Array, v: Array, theta: Array, steering: Array, time: float
    ) -> tuple[Arc, Array]:
        """Return the arc driven in ``time`` seconds and the heading at its end.

        s, f (m), v (m/s), theta (rad) and steering (delta, rad) share one batch shape.
        """
        slope = np.tan(steering)
        wheelbase = self.front + self.rear
        if self.slip:
            beta = np.arctan(self.rear * slope / wheelbase)
            course, curvature = theta + beta, np.cos(beta) * slope / wheelbase
        else:
            course, curvature = theta, slope / wheelbase
        distance = self.distance_after(v, time)
        return Arc(s, f, course, curvature, distance), theta + curvature * distance


def _sinc(x: Array) -> Array:
    """Return sin(x) / x, 1 at 0."""
    x = np.where(x == 0, 1e-20, x)
    return np.sin(x) / x

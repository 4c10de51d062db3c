"""The privileged teacher: pure pursuit of a fixed line by a driver that knows the state.

The line, in the frame of a hall of width W that turns right: straight at ``lane`` metres
from the left wall, a quarter circle, straight again at ``lane`` metres from the next left
wall. The circle's centre is (c, c), c = lane + radius, on the diagonal of the corner, so the
line is its own mirror image: what is s before the turn is f after it.

At lane 0.5 m and radius 1.8 m the margin of the line itself is 0.2 m on the straights. At the
corner the circle is nearest to the inner block on the diagonal, where s = f = c - radius /
sqrt(2) = 1.03 m: there max(W - s, W - f) = 0.47 m and the margin is 0.17 m.

Pure pursuit (Coulter 1992): from where the car is, aim at the point of the line that is
``look`` metres further on, along the circle through it that is tangent to the heading: its
curvature is 2 y / d^2, with y the point's offset to the left and d its distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from racecar.bicycle import Bicycle
from racecar.env import MAX_STEERING
from racecar.polygon import Array


@dataclass(frozen=True)
class Teacher:
    """A driver that sees the state; lengths in metres.

    lane: distance of the line from the left wall; radius: of the quarter circle; look_turn,
    look_straight: how far ahead it aims in the turn and far from it.
    """

    lane: float = 0.5
    radius: float = 1.8
    look_turn: float = 0.7
    look_straight: float = 2.0

    #: The look-ahead grows from the first to the second of these distances (m) from the front
    #: wall before the turn, from the last left wall after it.
    near: float = 2.5
    far: float = 4.5

    def line(self, along: Array) -> tuple[Array, Array]:
        """Return the points (s, f) of the line at arc lengths from the circle's start."""
        centre, quarter = self.lane + self.radius, math.pi / 2 * self.radius
        angle = np.clip(along, 0.0, quarter) / self.radius
        before, after = np.minimum(along, 0.0), np.maximum(along - quarter, 0.0)
        s = centre - self.radius * np.cos(angle) + after
        f = centre - self.radius * np.sin(angle) - before
        return s, f

    def nearest(self, s: Array, f: Array) -> Array:
        """Return the arc length (m) of the line's point nearest to (s, f), 0 at the circle's start.

        Before the circle it is negative.
        """
        centre, quarter = self.lane + self.radius, math.pi / 2 * self.radius
        angle = np.clip(np.arctan2(centre - f, centre - s), 0.0, math.pi / 2)
        past = np.where(s > centre, quarter + s - centre, angle * self.radius)
        return np.where(f > centre, centre - f, past)

    def look_ahead(self, s: Array, f: Array) -> Array:
        """Return how far ahead (m) it aims."""
        away = np.clip((np.maximum(s, f) - self.near) / (self.far - self.near), 0.0, 1.0)
        return self.look_turn + (self.look_straight - self.look_turn) * away

    def __call__(self, s: Array, f: Array, theta: Array) -> Array:
        """Return the steering (rad) for states in the frame of a hall that turns right."""
        aim_s, aim_f = self.line(self.nearest(s, f) + self.look_ahead(s, f))
        ds, df = aim_s - s, aim_f - f
        left = np.sin(theta) * df - np.cos(theta) * ds
        curvature = 2 * left / (ds * ds + df * df)
        car = Bicycle()
        steering = np.arctan(curvature * (car.front + car.rear))
        return np.clip(steering, -MAX_STEERING, MAX_STEERING)

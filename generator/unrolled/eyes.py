"""What a car near the turn's inner corner sees, and the values that say whether a view is right.

A value is at least 0 where something holds. ``g1`` and ``g2`` are by how much the car is outside
of the block's faces before and after the turn; ``c`` of a ray is the cross product that is at
least 0 where the ray points to the right of the corner.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from generator.unrolled.geometry import Area, kept_gap
from generator.unrolled.graph import Task
from generator.unrolled.patterns import Corner, Side, View, splits
from generator.unrolled.step import Pose, approach, inverse_distance, miss
from generator.unrolled.tape import Tape

#: Normals of the block's faces beside the halls before and after the turn.
_FACES = {Side.BEFORE: np.array([-1.0, 0.0]), Side.AFTER: np.array([0.0, -1.0])}
#: Headings along these halls, right turn.
_AHEAD = {Side.BEFORE: 0.0, Side.AFTER: -math.pi / 2}
_NEAR = {Side.FAR_BEFORE: Side.BEFORE, Side.FAR_AFTER: Side.AFTER}


class Eyes:
    """A car at a control instant; every value is computed once.

    Args:
        tape: what it is added to.
        at: the pose.
        task: what is unrolled.
        area: where the car can be if its view is right.
        corner: the turn's inner corner.
        limit: how far the heading may be off the halls (rad).
    """

    def __init__(
        self, tape: Tape, at: Pose, task: Task, area: Area, corner: Corner, limit: float
    ) -> None:
        self.tape, self.at, self.task, self.area = tape, at, task, area
        self.corner, self.limit, self.lidar = corner, limit, task.plant.lidar
        self._made: dict[str, str] = {}

    def block(self, view: View) -> str:
        """Return the inverse distance to the block, ``[batch, rays]``; at most 0: not hit."""
        if view.side == Side.CORNER:
            return self.tape.apply(
                "Min", self._face(Side.BEFORE, None), self._face(Side.AFTER, None), name="block"
            )
        side = _NEAR.get(view.side, view.side)
        if view.side in _NEAR:
            return self._face(side, None)
        rays = np.arange(self.lidar.rays)
        return self._face(side, rays < view.split if side == Side.BEFORE else rays >= view.split)

    def guards(self, view: View) -> list[str]:
        """Return values that are all at least 0 only where the view is right."""
        outside, beside = self._gap(Side.BEFORE), self._gap(Side.AFTER)
        if view.side == Side.CORNER:
            return [outside, beside]
        side = _NEAR.get(view.side, view.side)
        if side == Side.AFTER:
            outside, beside = beside, outside
        if view.side in _NEAR:
            return [outside, self._far(side), *self._headings(side)]
        return [
            outside,
            self._minus(beside),
            *self._headings(side),
            *self._between(side, view.split, view.split),
        ]

    def cover(self, among: Sequence[View]) -> str:
        """Return a value that is at least 0 only where one of several views is right.

        It is positive, not 0, where the car passes from one of them to another.
        """
        g1, g2 = self._gap(Side.BEFORE), self._gap(Side.AFTER)
        clauses = [[g1, g2]]
        if View(Side.CORNER) not in among:
            clauses.append([self._minus(g1), self._minus(g2)])
        for far, side, gap in (
            (Side.FAR_BEFORE, Side.BEFORE, g2),
            (Side.FAR_AFTER, Side.AFTER, g1),
        ):
            elsewhere = [gap]
            if View(far) in among:
                near = self._minus(self._far(side))
                clauses += [[heading, near] for heading in self._headings(side)]
                elsewhere.append(self._far(side))
            between = splits(among, side)
            if between is None:
                clauses.append(elsewhere)
            else:
                conditions = [*self._headings(side), *self._between(side, *between)]
                clauses += [[condition, *elsewhere] for condition in conditions]
        values = [self.tape.fold("Max", clause, f"clause{i}") for i, clause in enumerate(clauses)]
        return self.tape.fold("Min", values, "cover")

    def _made_by(self, name: str, make: Callable[[str], str]) -> str:
        if name not in self._made:
            self._made[name] = make(name)
        return self._made[name]

    def _gap(self, side: Side) -> str:
        """Return how far the car is outside of a face."""
        offset = self._offset(side)
        return self._made_by(
            f"g{side}", lambda x: miss(self.tape, self.at, _FACES[side], offset, x)
        )

    def _offset(self, side: Side) -> float:
        return -self.corner.s if side == Side.BEFORE else -self.corner.f

    def _minus(self, value: str) -> str:
        short = f"{value.removeprefix(self.tape.prefix)}-"
        return self._made_by(short, lambda x: self.tape.affine(value, -1.0, 0.0, x))

    def _far(self, side: Side) -> str:
        """Return by how much the corner is out of reach along the hall."""
        along = self._gap(Side.AFTER if side == Side.BEFORE else Side.BEFORE)
        return self._made_by(
            f"far{side}", lambda x: self.tape.affine(along, -1.0, -self.lidar.range, x)
        )

    def _headings(self, side: Side) -> list[str]:
        """Return by how much the heading is within the limit, to the left and to the right."""
        low, high = _AHEAD[side] - self.limit, _AHEAD[side] + self.limit
        return [
            self._made_by(f"left{side}", lambda x: self.tape.affine(self.at.theta, -1.0, high, x)),
            self._made_by(f"right{side}", lambda x: self.tape.affine(self.at.theta, 1.0, -low, x)),
        ]

    def _between(self, side: Side, least: int, most: int) -> list[str]:
        """Return values that say that from ``least`` to ``most`` rays are right of the corner."""
        rays, values = self.lidar.rays, []
        if least > 0:
            values.append(self._made_by(f"c{least - 1}", lambda x: self._cross(least - 1, 1.0, x)))
        if most < rays:
            values.append(self._made_by(f"n{most}", lambda x: self._cross(most, -1.0, x)))
            return values
        # c of the last ray is positive also where it points to the left of what is opposite of
        # the corner. The corner's own bearing is at most this.
        bearing = _AHEAD[side] * 2 - float(self.lidar.angles[-1])
        last = self._made_by(
            f"last{side}", lambda x: self.tape.affine(self.at.theta, -1.0, bearing, x)
        )
        if least < rays:
            not_right = self._made_by(f"n{rays - 1}", lambda x: self._cross(rays - 1, -1.0, x))
            last = self._made_by(
                f"any{side}", lambda x: self.tape.apply("Max", last, not_right, name=x)
            )
        return [*values, last]

    def _cross(self, ray: int, sign: float, name: str) -> str:
        """Return ``sign * c`` of a ray."""
        both = self._made_by(
            "sc", lambda x: self.tape.apply("Concat", self.at.sine, self.at.cosine, name=x, axis=1)
        )
        parts = []
        for side, other, factor in (
            (Side.AFTER, Side.BEFORE, sign),
            (Side.BEFORE, Side.AFTER, -sign),
        ):
            weights = factor * approach(self.lidar, _FACES[side])[:, ray]
            h = self.tape.column(both, weights, f"{name}.h{side}")
            parts.append(self.tape.apply("Mul", h, self._gap(other), name=f"{name}.{side}"))
        return self.tape.apply("Add", *parts, name=name)

    def _face(self, side: Side, mask: NDArray[np.bool_] | None) -> str:
        """Return the inverse distance to a face's line for the rays in the mask, 0 for others."""
        normal, gap = _FACES[side], self._gap(side)
        kept = kept_gap(self.task.safety.unsafe[0], self.area, normal, self._offset(side))
        return inverse_distance(
            self.tape, self.at, self.lidar, normal, gap, f"face{side}", kept, mask
        )

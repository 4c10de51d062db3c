"""Wall patterns: what makes the LiDAR's formula one smooth expression.

Near a right turn only the inner corner makes readings jump: beside a hall a ray either meets the
block's face or passes its corner. A *view* says where the car is relative to the corner and how
many rays point to the right of the corner; a *pattern* is one view for every control instant.

    far before   the corner is out of reach ahead; every ray meets the face as if it went on
    before       in the hall before the turn; rays right of the corner meet its face
    corner       in the corner square: the first hit is a plain minimum, no ray jumps
    after        in the hall after the turn; rays right of the corner pass behind it
    far after    the corner is out of reach behind

Heading and position are limited such that the two rays next to the corner decide about all
(docs/vnnlib.md has the argument).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np

from generator.unrolled.geometry import step_distances
from generator.unrolled.graph import Task
from generator.unrolled.step import plant_series
from racecar.closed_loop import Plant, State
from racecar.errors import BadInput
from racecar.polygon import Array, Polygon


class Side(IntEnum):
    """Where the car is, seen from the inner corner."""

    FAR_BEFORE = 0
    BEFORE = 1
    CORNER = 2
    AFTER = 3
    FAR_AFTER = 4


@dataclass(frozen=True, order=True)
class View:
    """side; split: how many rays point to the right of the corner (0 where no ray jumps)."""

    side: Side
    split: int = 0


#: One view for each control instant but the last.
Pattern = tuple[View, ...]


@dataclass(frozen=True, eq=False)
class Corner:
    """The inner corner of the first hall's right turn: the block is {s >= self.s, f >= self.f}.

    block: the wall that has this corner; half_planes: all others.
    """

    s: float
    f: float
    block: Polygon
    others: tuple[Polygon, ...]


def find_corner(plant: Plant) -> Corner:
    """Return the corner; BadInput for a track whose first hall does not turn right."""
    walls = plant.track.frames[0].obstacles
    for wall in walls:
        sides = {
            tuple(n): float(b) for n, b in zip(wall.normals.tolist(), wall.offsets, strict=True)
        }
        if (-1.0, 0.0) in sides and (0.0, -1.0) in sides:
            others = tuple(other for other in walls if other is not wall)
            return Corner(-sides[-1.0, 0.0], -sides[0.0, -1.0], wall, others)
    raise BadInput("wall patterns are made for a first hall that turns right")


def heading_limit(task: Task) -> float:
    """Return how far (rad) the heading may be off the hall for the patterns to be right.

    No ray may then point backwards past the hall's direction, the first ray points to the right
    of it, and during the next step the car drives on along the hall. Raises BadInput if no
    heading is left.
    """
    plant = task.plant
    slope, shift = step_distances(plant.bicycle, plant.period, task.steps)
    longest = float(np.max(slope * task.start.upper[2] + shift))
    turn = 2 * plant_series(plant, task.controller, longest).limit
    half = plant.lidar.field_of_view / 2
    limit = min(half, math.pi - half, math.pi / 2 - turn)
    if limit <= 0:
        raise BadInput("the LiDAR looks too far back for wall patterns")
    return limit


def views(plant: Plant, corner: Corner, s: Array, f: Array, theta: Array) -> list[View]:
    """Return the view of every car, positions in the first hall's frame."""
    before, after = f > corner.f, s > corner.s
    reach = plant.lidar.range
    bearing = np.arctan2(s - corner.s, f - corner.f)  # of the corner: (-sin, -cos) points to it
    bearing = np.where(after, bearing - 2 * math.pi, bearing)
    right = np.sum(theta[:, None] + plant.lidar.angles < bearing[:, None], axis=1)
    side = np.select(
        [f >= corner.f + reach, before, s >= corner.s + reach, after],
        [Side.FAR_BEFORE, Side.BEFORE, Side.FAR_AFTER, Side.AFTER],
        Side.CORNER,
    )
    split = np.where((side == Side.BEFORE) | (side == Side.AFTER), right, 0)
    return [View(Side(a), int(b)) for a, b in zip(side.tolist(), split.tolist(), strict=True)]


def met_patterns(task: Task, starts: Array) -> tuple[list[Pattern], Array]:
    """Return the pattern of each start ``[batch, 4]`` and its least margin (m) at control instants.

    The runs are the simulator's, in the frame of the first hall throughout.
    """
    plant, corner = task.plant, find_corner(task.plant)
    state = State.start(*starts.T)
    seen: list[list[View]] = []
    least = plant.margin(task.safety, state)
    for _ in range(task.steps):
        seen.append(views(plant, corner, state.s, state.f, state.theta))
        steering = task.controller.steering_rows(plant.scan_rows(state))
        state, _ = plant.drive(state, steering)
        least = np.minimum(least, plant.margin(task.safety, state))
    return list(zip(*seen, strict=True)), least


def find_patterns(task: Task, enough: int, density: int = 401) -> tuple[list[Pattern], float]:
    """Return the patterns met from a dense line of starts, and the least margin (m) among them.

    The line joins the corners of the start box. Where neighbours differ, more starts between
    them are tried, so that a pattern between two others is not missed; that none is missed for
    certain is for the cover instances to show. With more than ``enough`` the search ends.
    """
    share = np.linspace(0.0, 1.0, density)
    found: dict[Pattern, float] = {}
    least = math.inf
    for _ in range(3):
        line = task.start.lower + share[:, None] * (task.start.upper - task.start.lower)
        patterns, margins = met_patterns(task, line)
        least = min(least, float(margins.min()))
        for x, pattern in zip(share.tolist(), patterns, strict=True):
            found[pattern] = min(x, found.get(pattern, math.inf))
        changes = [i for i, (a, b) in enumerate(pairwise(patterns)) if a != b]
        if not changes or len(found) > enough:
            break
        between = [np.linspace(share[i], share[i + 1], 33) for i in changes]
        share = np.unique(np.concatenate(between))
    return sorted(found, key=lambda pattern: (found[pattern], pattern)), least


def siblings(patterns: Iterable[Pattern], pattern: Pattern, instant: int) -> list[View]:
    """Return the views at an instant of all patterns that begin like this one up to it."""
    begin = pattern[:instant]
    return sorted({other[instant] for other in patterns if other[:instant] == begin})


def connected(patterns: Sequence[Pattern]) -> bool:
    """Return whether nowhere a split is missing between two others, as the cover value needs."""
    try:
        for pattern in patterns:
            for instant in range(len(pattern)):
                for side in (Side.BEFORE, Side.AFTER):
                    splits(siblings(patterns, pattern, instant), side)
    except ValueError:
        return False
    return True


def splits(among: Iterable[View], side: Side) -> tuple[int, int] | None:
    """Return the least and the largest split on a side, None if the side is not there.

    Raises ValueError if a split between them is missing.
    """
    there = sorted(view.split for view in among if view.side == side)
    if not there:
        return None
    if there != list(range(there[0], there[-1] + 1)):
        raise ValueError(f"splits {there} of {side.name} leave a gap")
    return there[0], there[-1]

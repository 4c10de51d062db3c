"""The graph of one wall pattern: no comparison, and outputs that say whether the pattern holds.

Outputs, k steps: margins after step 1, ..., k; then, at the instants 0, ..., k - 1, the least guard
value so far (the pattern has held up to here if it is at least 0); then at the same instants the
cover value: at least 0 only where one of the listed patterns that begin alike goes on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import onnx
from numpy.typing import DTypeLike

from generator.unrolled.eyes import Eyes
from generator.unrolled.general import half_plane
from generator.unrolled.geometry import Area, walls_in_reach
from generator.unrolled.graph import Seen, Task, unroll
from generator.unrolled.patterns import (
    Corner,
    Pattern,
    Side,
    find_corner,
    heading_limit,
    siblings,
)
from generator.unrolled.step import Pose
from generator.unrolled.tape import Tape
from racecar.errors import BadInput

_BEFORE = {Side.FAR_BEFORE, Side.BEFORE}


def pattern_graph(
    task: Task,
    patterns: Sequence[Pattern],
    pattern: Pattern,
    dtype: DTypeLike = np.float32,
    metadata: Mapping[str, str] | None = None,
) -> onnx.ModelProto:
    """Return the network that is right where a pattern holds.

    patterns: all that are listed for the same starts. Raises BadInput where another wall than
    the corner's has two sides in reach.
    """
    corner, limit = find_corner(task.plant), heading_limit(task)
    guards: list[str] = []

    def see(tape: Tape, at: Pose, instant: int, area: Area) -> Seen:
        view = pattern[instant]
        area = _region(task, corner, pattern[: instant + 1], area)
        eyes = Eyes(tape, at, task, area, corner, limit)
        hits = [*_walls(eyes), eyes.block(view)]
        guard = tape.fold("Min", eyes.guards(view), "guard")
        together = siblings(patterns, pattern, instant)
        cover = guard if together == [view] else eyes.cover(together)
        guards.append(tape.fold("Min", [*guards[-1:], guard], "guards"))
        return Seen(hits, area, (guards[-1], cover))

    return unroll(task, see, dtype, metadata)


def _region(task: Task, corner: Corner, past: Pattern, area: Area) -> Area:
    """Return where the car can be at an instant if the guards of all views up to it hold.

    area: where it can be by the distance driven.
    """
    side, reach = past[-1].side, task.plant.lidar.range
    if side == Side.CORNER:
        return area.within((-math.inf, -math.inf), (corner.s, corner.f))
    if side in _BEFORE:
        # As long as it has been here its heading was within 90 degrees of the hall, at all times.
        first = task.start.upper[1] if all(view.side in _BEFORE for view in past) else math.inf
        least = corner.f + (reach if side == Side.FAR_BEFORE else 0.0)
        return area.within((-math.inf, least), (corner.s, float(first)))
    least = corner.s + (reach if side == Side.FAR_AFTER else 0.0)
    return area.within((least, -math.inf), (math.inf, corner.f))


def _walls(eyes: Eyes) -> list[str]:
    """Return the inverse distances to all walls but the corner's."""
    reach = eyes.task.plant.lidar.range
    block = walls_in_reach([eyes.corner.block], eyes.area, reach)
    near = walls_in_reach(eyes.corner.others, eyes.area, reach)
    faces = {tuple(normal) for wall in block for normal in wall.normals.tolist()}
    if any(len(wall.offsets) > 1 for wall in near) or not faces <= {(-1.0, 0.0), (0.0, -1.0)}:
        raise BadInput("another corner than the turn's is in reach; no wall patterns are made")
    return [
        half_plane(eyes.tape, eyes.at, eyes.task, eyes.area, wall, f"w{k}")
        for k, wall in enumerate(near)
    ]

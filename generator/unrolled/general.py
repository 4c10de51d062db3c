"""The general graph: right wherever the car is, walls chosen by comparison.

Wall by wall as in racecar.lidar: a ray meets a convex wall where it has entered all constraints
that the car is outside of, unless it has left one of the others before. Only walls with several
constraints in reach need comparisons.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx
from numpy.typing import DTypeLike

from generator.unrolled.geometry import Area, kept_gap, walls_in_reach
from generator.unrolled.graph import Seen, Task, unroll
from generator.unrolled.step import Pose, inverse_distance, miss
from generator.unrolled.tape import Tape
from racecar.lidar import Lidar
from racecar.polygon import Polygon

#: A car nearer than this to a wall's line (m) counts as on it, so that no inverse is infinite.
TOUCHING = 2.0**-100
#: Beyond every inverse distance (1/m).
_HUGE = 2.0**104


def general_graph(
    task: Task, dtype: DTypeLike = np.float32, metadata: Mapping[str, str] | None = None
) -> onnx.ModelProto:
    """Return the network from a start state to the margin after each step.

    It is right up to the first margin that is not positive; what follows has no meaning.
    """
    lidar, walls = task.plant.lidar, task.plant.track.frames[0].obstacles

    def see(tape: Tape, at: Pose, step: int, area: Area) -> Seen:
        del step
        hits = []
        for k, wall in enumerate(walls_in_reach(walls, area, lidar.range)):
            if len(wall.offsets) == 1:  # a car that is safe is outside of it
                hits.append(half_plane(tape, at, task, area, wall, f"w{k}"))
            else:
                hits.append(_first_hit(tape, at, lidar, wall, f"w{k}"))
        return Seen(hits, area)

    return unroll(task, see, dtype, metadata)


def _first_hit(tape: Tape, at: Pose, lidar: Lidar, wall: Polygon, name: str) -> str:
    """Return the inverse distance to a wall ``[batch, rays]``; at most 0 where it is not hit."""
    entries, exits = [], []
    for j, (normal, offset) in enumerate(zip(wall.normals, wall.offsets, strict=True)):
        label = f"{name}.{j}"
        gap = miss(tape, at, normal, offset, label)
        outside = tape.apply("Greater", gap, tape.scalar(0.0), name=f"{label}.outside")
        beyond = tape.apply("Max", gap, tape.scalar(TOUCHING), name=f"{label}.beyond")
        within = tape.apply("Min", gap, tape.scalar(-TOUCHING), name=f"{label}.within")
        enter = inverse_distance(tape, at, lidar, normal, beyond, f"{label}.enter")
        leave = inverse_distance(tape, at, lidar, normal, within, f"{label}.leave")
        huge, none = tape.scalar(_HUGE), tape.scalar(-_HUGE)
        entries.append(tape.apply("Where", outside, enter, huge, name=f"{label}.entry"))
        exits.append(tape.apply("Where", outside, none, leave, name=f"{label}.exit"))
    first = tape.fold("Min", entries, f"{name}.first")
    last = tape.fold("Max", exits, f"{name}.last")
    hit = tape.apply("GreaterOrEqual", first, last, name=f"{name}.hit")
    return tape.apply("Where", hit, first, tape.scalar(0.0), name=name)


def half_plane(tape: Tape, at: Pose, task: Task, area: Area, wall: Polygon, name: str) -> str:
    """Return the inverse distance to a wall with one side, ``[batch, rays]``."""
    normal, offset = wall.normals[0], float(wall.offsets[0])
    kept = kept_gap(task.safety.unsafe[0], area, normal, offset)
    gap = miss(tape, at, normal, offset, f"{name}.gap")
    return inverse_distance(tape, at, task.plant.lidar, normal, gap, name, kept)

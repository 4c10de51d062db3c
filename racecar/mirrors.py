"""Walls that mirror: where their stretches lie, and which rays they take.

Everything is in the global frame: a stretch of wall stays where it is when the car's local
frame changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.closed_loop import Plant, State
from racecar.disturbance import Mirrors
from racecar.faultmodels.spec import Segment
from racecar.polygon import Array, Polygon
from racecar.track import Track

#: How far (m) beside a stretch a ray may end and still be on its wall: rounding. Along the wall
#: the ends are exact.
_BESIDE = 1e-8
#: How far (m) from a wall's face the ends of a stretch may lie.
_FACE = 1e-9


def stretch_ends(segments: Sequence[Segment], track: Track) -> Array:
    """Return the ends of stretches in the global frame: ``[segments, 2, 2]``, metres.

    The last two axes are (begin, end) and (x, y).
    """
    hall = [[x.hall] * 2 for x in segments]
    points = np.array([[x.begin, x.end] for x in segments], dtype=float).reshape(-1, 2, 2)
    x, y, _ = track.to_global(
        np.array(hall, dtype=int).reshape(-1, 2), points[..., 0], points[..., 1], 0.0
    )
    return np.stack([x, y], axis=-1)


def lost_rays(
    plant: Plant, incidence: float, ends: Array, state: State, scan: Array
) -> NDArray[np.bool_]:
    """Return which rays are lost, ``[rays, runs]``.

    incidence: rad; ends: ``[stretches, runs, 2, 2]`` as those of stretch_ends, all of them mirror;
    scan: undisturbed, ``[rays, runs]``, m. A ray is lost if it meets one of the stretches, the
    ends included, with more than ``incidence`` between itself and the wall's normal.
    """
    x, y, heading = plant.track.to_global(state.frame, state.s, state.f, state.theta)
    angle = heading + plant.lidar.angles[:, None]
    cosine, sine = np.cos(angle), np.sin(angle)
    hit_x, hit_y = x + scan * cosine, y + scan * sine
    lost = np.zeros(scan.shape, dtype=bool)
    for segment in ends:
        begin, along = segment[:, 0], segment[:, 1] - segment[:, 0]
        length = np.hypot(along[:, 0], along[:, 1])
        unit_x, unit_y = along.T / np.maximum(length, _BESIDE)
        far_x, far_y = hit_x - begin[:, 0], hit_y - begin[:, 1]
        place = far_x * unit_x + far_y * unit_y
        beside = far_x * unit_y - far_y * unit_x
        on = (np.abs(beside) <= _BESIDE) & (place >= 0) & (place <= length)
        # The sine of the angle to the wall is the cosine of that to its normal.
        shallow = np.abs(cosine * unit_y - sine * unit_x) < math.cos(incidence)
        lost |= on & shallow & (length > _BESIDE)
    return lost & (scan < plant.lidar.range)


@dataclass(frozen=True, eq=False)
class Mirroring:
    """Which stretch of wall mirrors in each of a batch of runs.

    incidence: rad; ends: of all stretches (stretch_ends); chosen: ``[runs]``, or one for all
    runs: the index of the stretch that mirrors for the whole run, or -1: none does.
    """

    plant: Plant
    incidence: float
    ends: Array
    chosen: NDArray[np.intp]

    def lost(self, state: State, scan: Array) -> NDArray[np.bool_]:
        """Return which rays are lost, ``[rays, runs]``; scan: undisturbed, metres."""
        chosen = np.broadcast_to(self.chosen, len(state))
        lost = np.zeros(scan.shape, dtype=bool)
        some = np.flatnonzero(chosen >= 0)
        if some.size:
            ends = self.ends[chosen[some]][None]
            lost[:, some] = lost_rays(
                self.plant, self.incidence, ends, state.take(some), scan[:, some]
            )
        return lost


def mirroring(mirrors: Mirrors | None, plant: Plant, chosen: ArrayLike) -> Mirroring | None:
    """Return the mirrors of runs; None if no wall may mirror.

    chosen: the index of a segment, or -1, for each run or for all of them.
    """
    if mirrors is None:
        return None
    return Mirroring(
        plant,
        mirrors.incidence,
        stretch_ends(mirrors.segments, plant.track),
        np.atleast_1d(np.asarray(chosen, dtype=np.intp)),
    )


def complaint_about(segment: Segment, track: Track) -> str | None:
    """Return why a segment is no stretch of one straight wall of its hall's frame; None if it is.

    Its ends may lie up to 1e-9 m off the wall's face.
    """
    count = len(track.halls)
    if segment.hall >= count:
        return f"it is in hall {segment.hall}; the track has halls 0 to {count - 1}"
    begin, end = np.array(segment.begin), np.array(segment.end)
    if math.dist(begin, end) <= _FACE:
        return "its two ends are the same point; give a stretch of wall"
    walls = track.frames[segment.hall].obstacles
    if not any(_on_face(i, walls, begin, end) for i in range(len(walls))):
        return (
            f"from {segment.begin} to {segment.end} it does not lie on one straight wall "
            f"in the frame of hall {segment.hall}; put both ends on the same face"
        )
    return None


def _on_face(index: int, walls: Sequence[Polygon], begin: Array, end: Array) -> bool:
    """Tell whether the stretch lies on a side of a wall, with no other wall in front of it."""
    wall = walls[index]
    misses = wall.misses(*np.stack([begin, end], axis=1))
    if np.any(misses > _FACE):
        return False
    for side in np.flatnonzero(np.all(np.abs(misses) <= _FACE, axis=1)):
        before = 4 * _FACE * wall.normals[side]
        others = (w for i, w in enumerate(walls) if i != index)
        if not any(_shared(other, begin + before, end + before) for other in others):
            return True
    return False


def _shared(wall: Polygon, begin: Array, end: Array) -> bool:
    """Tell whether more than a point of the line from ``begin`` to ``end`` is inside a wall."""
    first, last = wall.misses(*np.stack([begin, end], axis=1)).T
    change = last - first
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = np.where(change != 0, -first / change, np.nan)
    low = max(0.0, *cross[change < 0]) if np.any(change < 0) else 0.0
    high = min(1.0, *cross[change > 0]) if np.any(change > 0) else 1.0
    inside = bool(np.all(first[change == 0] <= 0))
    return inside and (high - low) * math.dist(begin, end) > 2 * _FACE

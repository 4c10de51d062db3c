"""Reflective walls: which rays meet a segment of wall beyond an angle of incidence.

Everything is in the global frame: a segment of wall stays where it is when the car's local
frame changes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import Plant, State
from racecar.errors import BadInput
from racecar.faultmodels.numbers import uniforms
from racecar.faultmodels.spec import DrawnSegments, Reflective, Segment
from racecar.polygon import Array

#: How far (m) from a segment a reading may end and still be on it: rounding.
_ON = 1e-6


def segment_ends(spec: Reflective, plant: Plant, key: int, runs: NDArray[np.uint64]) -> Array:
    """Return the ends of the segments in the global frame: ``[segments, runs, 2, 2]``, metres.

    The last two axes are (begin, end) and (x, y); key: of the random numbers.
    """
    count = len(plant.track.halls)
    for segment in spec.segments:
        if segment.hall >= count:
            raise BadInput(
                f"faults: a segment is in hall {segment.hall}; the track has halls 0 to {count - 1}"
            )
    fixed = [
        np.broadcast_to(_given(segment, plant), (len(runs), 2, 2)) for segment in spec.segments
    ]
    drawn = [] if spec.drawn is None else _drawn(spec.drawn, plant, key, runs)
    return np.stack([*fixed, *drawn])


def _given(segment: Segment, plant: Plant) -> Array:
    (s0, f0), (s1, f1) = segment.begin, segment.end
    x, y, _ = plant.track.to_global(np.full(2, segment.hall), [s0, s1], [f0, f1], 0.0)
    return np.stack([x, y], axis=-1)


def _drawn(spec: DrawnSegments, plant: Plant, key: int, runs: NDArray[np.uint64]) -> list[Array]:
    """Place segments on the corner's two outer walls, laid out as one line through it."""
    found = []
    for number in range(spec.count):
        middle = spec.within * (2 * uniforms(key, runs, number) - 1)
        ends = np.stack([middle - spec.length / 2, middle + spec.length / 2])
        # The part beyond the corner is left out: a segment does not bend round it.
        ends = np.where(middle >= 0, np.maximum(ends, 0.0), np.minimum(ends, 0.0))
        s, f = np.maximum(ends, 0.0), np.maximum(-ends, 0.0)
        x, y, _ = plant.track.to_global(np.zeros(s.shape, dtype=int), s, f, 0.0)
        found.append(np.stack([x, y], axis=-1).transpose(1, 0, 2))
    return found


def lost_rays(
    plant: Plant, incidence: float, ends: Array, state: State, scan: Array
) -> NDArray[np.bool_]:
    """Return which rays are lost, ``[rays, runs]``.

    incidence: rad; ends: as segment_ends returns them; scan: undisturbed, ``[rays, runs]``, m.
    """
    x, y, heading = plant.track.to_global(state.frame, state.s, state.f, state.theta)
    angle = heading + plant.lidar.angles[:, None]
    cosine, sine = np.cos(angle), np.sin(angle)
    hit_x, hit_y = x + scan * cosine, y + scan * sine
    lost = np.zeros(scan.shape, dtype=bool)
    for segment in ends:
        begin, along = segment[:, 0], segment[:, 1] - segment[:, 0]
        length = np.hypot(along[:, 0], along[:, 1])
        unit_x, unit_y = along.T / np.maximum(length, _ON)
        far_x, far_y = hit_x - begin[:, 0], hit_y - begin[:, 1]
        place = far_x * unit_x + far_y * unit_y
        beside = far_x * unit_y - far_y * unit_x
        on = (np.abs(beside) <= _ON) & (place >= -_ON) & (place <= length + _ON)
        # The sine of the angle to the wall is the cosine of that to its normal.
        shallow = np.abs(cosine * unit_y - sine * unit_x) < math.cos(incidence)
        lost |= on & shallow & (length > _ON)
    return lost & (scan < plant.lidar.range)

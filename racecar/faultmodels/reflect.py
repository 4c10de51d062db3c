"""Reflective walls of a fault model: stretches that are given, and stretches drawn for each run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import Plant
from racecar.errors import BadInput
from racecar.faultmodels.numbers import uniforms
from racecar.faultmodels.spec import DrawnSegments, Reflective
from racecar.mirrors import stretch_ends
from racecar.polygon import Array


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
    fixed = stretch_ends(spec.segments, plant.track)[:, None]
    fixed = np.broadcast_to(fixed, (len(spec.segments), len(runs), 2, 2))
    if spec.drawn is None:
        return fixed
    return np.concatenate([fixed, _drawn(spec.drawn, plant, key, runs)])


def _drawn(spec: DrawnSegments, plant: Plant, key: int, runs: NDArray[np.uint64]) -> Array:
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
    return np.stack(found)

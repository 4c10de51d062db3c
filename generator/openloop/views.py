"""What a controller sees on its nominal drive, at several distances to the turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from racecar.closed_loop import Plant, State, simulate
from racecar.controller import Controller
from racecar.polygon import Array
from racecar.safety import named_property

#: Distances to the front wall (m), as decimal literals; the turn's inner corner is 1.5 m from it.
FRONTS = ("6", "4", "3", "2.5", "2")
#: The start (s, m) of the drive whose scans are taken, in the middle of the benchmark's range.
MIDDLE = Fraction(3, 4)
#: Starts across the range, whose scans give the lowest and the highest readings.
_STARTS, _STEPS = 21, 70
#: Readings are rounded to this part of a metre: about a millimetre, as LiDARs report them, exact
#: in float32, and coarse enough that no last bit of a simulation shows in a file.
UNIT = Fraction(1, 1024)
Units = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class View:
    """Scans at the first control instant at which the front wall is at most so far away.

    front: decimal literal, m; start: of the drive (s, m); step: the control instant; scan: of
    this drive, ``[rays]``; lowest, highest: over drives from all over the start range at this
    instant, ``[rays]``; reach: the LiDAR's range; all in multiples of UNIT. steering: of the
    scan, rad.
    """

    front: str
    start: Fraction
    step: int
    scan: Units
    lowest: Units
    highest: Units
    reach: int
    steering: float

    @property
    def label(self) -> str:
        """What an ID calls the place, such as f2.5m."""
        return f"f{self.front}m"

    @property
    def metres(self) -> Array:
        """The scan in metres, ``[rays]``."""
        return np.asarray(self.scan * float(UNIT))


def nominal_views(
    controller: Controller, plant: Plant, fronts: Sequence[str], start: Fraction = MIDDLE
) -> list[View]:
    """Return what the controller sees at the given distances on the drive from s = ``start``.

    Readings are rounded to the nearest multiple of UNIT, their lowest and highest values
    outwards. A distance that the car does not come to in the first hall is left out.
    """
    starts = [float(start), *np.linspace(0.65, 0.85, _STARTS)]
    scans = np.full((_STEPS, len(starts), controller.rays), np.nan)

    def keep(step: int, state: State, scan: Array) -> Array:
        scans[step] = scan.T
        return scan

    runs = simulate(
        plant,
        controller.steering_rows,
        named_property("clearance", plant.track),
        State.start(starts),
        _STEPS,
        disturb=keep,
        record=True,
    )
    assert runs.trace is not None
    driving = np.isfinite(runs.trace["steering"]).T & (runs.trace["frame"][:, :-1] == 0).T
    front = runs.trace["f"].T
    reach = round(plant.lidar.range / UNIT)
    views = []
    for literal in fronts:
        there = np.flatnonzero(driving[:, 0] & (front[:-1, 0] <= float(literal)))
        if not there.size:
            continue
        step = int(there[0])
        # Rounded to less than a nanometre first: 5 m is 5 m, whatever the last bit of it.
        seen = np.round(scans[step] / float(UNIT), 6)
        met = seen[driving[step]]
        scan = np.round(seen[0]).astype(np.int64)
        views.append(
            View(
                literal,
                start,
                step,
                scan,
                np.floor(met.min(axis=0)).astype(np.int64),
                np.ceil(met.max(axis=0)).astype(np.int64),
                reach,
                float(controller.steering(scan[None] * float(UNIT))[0]),
            )
        )
    return views

"""What the picture of an instance shows, as the script file that its page loads.

Numbers are rounded for drawing: lengths to 0.1 mm, angles to 0.1 mrad. Those of runs are whole
multiples of these, which are shorter to write.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.traces import Trace
from leaderboard.tube import Tube
from racecar.closed_loop import Plant
from racecar.faultmodels.spec import Segment
from racecar.figure import clip
from racecar.mirrors import stretch_ends
from racecar.polygon import Array, Polygon
from racecar.safety import Property

#: Metres shown around all that is drawn.
FRINGE = 0.7
#: So much more than its view a picture may show, as a part of the longer side.
_AROUND = 1.5
_DIGITS = 4


def scene(
    plant: Plant,
    safety: Property,
    traces: Sequence[Trace],
    witness: tuple[str, Trace] | None,
    tube: Tube | None,
    mirrors: Sequence[Segment] = (),
) -> dict[str, Any]:
    """Return what the page's script draws; lengths in metres, angles in radians.

    witness: the tool that gave it, and its run; mirrors: the stretches of wall of which one may
    mirror.
    """
    shown = [*traces, *([witness[1]] if witness else [])]
    points = [np.column_stack([t.x, t.y]) for t in shown]
    if tube is not None:
        points += [polygon for step in tube.steps for polygon in step]
    everything = np.vstack(points)
    low, high = everything.min(axis=0) - FRINGE, everything.max(axis=0) + FRINGE
    lidar, car = plant.lidar, plant.bicycle
    return {
        "period": plant.period,
        "lidar": {"rays": lidar.rays, "view": lidar.field_of_view, "range": lidar.range},
        "car": {"front": car.front, "rear": car.rear},
        "view": [_round(value) for value in (low[0], low[1], high[0], high[1])],
        "walls": _walls(plant, low, high),
        "unsafe": _unsafe(safety, low, high),
        "mirrors": _polygons(list(stretch_ends(mirrors, plant.track))),
        "traces": [_trace(trace) for trace in traces],
        "witness": witness and {"tool": witness[0], **_trace(witness[1])},
        "tube": tube and {"margin": tube.margin, "steps": [_polygons(s) for s in tube.steps]},
    }


def script(name: str, key: str, data: Mapping[str, Any]) -> bytes:
    """Return a script that hands ``data`` to the page; its first line says what it was made of."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return f"{key_line(key)}\nClosedLap.{name} = {text};\n".encode()


def key_line(key: str) -> str:
    """Return the first line of a script that was made from what ``key`` names."""
    return f"// made from {key}"


def _walls(plant: Plant, low: Array, high: Array) -> list[list[list[float]]]:
    """Return the walls in and around the view, and those that rays from it may meet."""
    reach = max(plant.lidar.range + 1.0, float(_AROUND * np.max(high - low)))
    return _clipped(plant.track.walls, low - reach, high + reach)


def _unsafe(safety: Property, low: Array, high: Array) -> list[list[list[float]]]:
    """Return the unsafe set in and around the view.

    The first hall's frame knows all of it: there x = -f and y = -s.
    """
    around = _AROUND * np.max(high - low)  # a picture may be wider, or higher, than its view
    local = (-(high + around)[::-1], -(low - around)[::-1])
    corners = [clip(polygon, *local) for polygon in safety.unsafe[0]]
    return [_points(-c[:, ::-1]) for c in corners if len(c) > 2]


def _clipped(polygons: Sequence[Polygon], low: Array, high: Array) -> list[list[list[float]]]:
    corners = [clip(polygon, low, high) for polygon in polygons]
    return [_points(c) for c in corners if len(c) > 2]


def _polygons(polygons: Sequence[Array]) -> list[list[list[float]]]:
    return [_points(polygon) for polygon in polygons]


def _points(corners: Array) -> list[list[float]]:
    rounded: list[list[float]] = (np.round(corners, _DIGITS) + 0.0).tolist()
    return rounded


def _trace(trace: Trace) -> dict[str, Any]:
    data: dict[str, Any] = {
        "start": list(trace.start),
        "x": _numbers(trace.x),
        "y": _numbers(trace.y),
        "heading": _numbers(trace.heading),
        "margin": _numbers(trace.margin),
        "least": _numbers(trace.least),
        "steering": _numbers(trace.steering),
        "crashed": trace.crashed,
    }
    if any(trace.missing):
        data["missing"] = [list(rays) for rays in trace.missing]
    if trace.mirror is not None:
        data["mirror"] = trace.mirror
    return data


def _numbers(values: Array) -> list[int | None]:
    """Return multiples of 0.0001; null for what is not finite."""
    finite = np.isfinite(values)
    whole: list[int | None] = (
        np.rint(np.where(finite, values, 0) * 10**_DIGITS).astype(int).tolist()
    )
    if finite.all():
        return whole
    return [value if there else None for value, there in zip(whole, finite, strict=True)]


def _round(value: float) -> float:
    return round(float(value), _DIGITS)

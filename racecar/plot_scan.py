"""One LiDAR scan, taken at a pose and drawn, as in Figure 3 of HSCC 2020."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patches import Polygon as Area
from numpy.typing import NDArray

from racecar.closed_loop import Plant, State, Steer
from racecar.errors import BadInput
from racecar.experiment import block_random, check_free, draw_faults
from racecar.faultmodels.spec import FaultSpec
from racecar.faults import Faults
from racecar.figure import (
    BLUE,
    FRINGE,
    INK,
    SKY,
    VERMILLION,
    WALL,
    View,
    draw_legend,
    draw_track,
    new_figure,
    style,
)
from racecar.polygon import Array

# Of the car as drawn, metres: the body beyond the axles and its width; the wheels.
_OVERHANG, _BODY = 0.05, 0.2
_WHEEL, _TYRE, _GAUGE = 0.11, 0.05, 0.25


@dataclass(frozen=True)
class Scan:
    """One LiDAR scan.

    state: one car; distances: ``[rays]``, metres, as the controller reads them; missing:
    ``[rays]``, which rays are missing; steering: the controller's answer, radians.
    """

    state: State
    distances: Array
    missing: NDArray[np.bool_]
    steering: float | None = None


def take_scan(
    plant: Plant,
    s: float,
    f: float,
    theta: float,
    faults: Faults | FaultSpec,
    seed: int = 0,
    steer: Steer | None = None,
) -> Scan:
    """Take a scan at a pose (m, m, rad) in the first hall, with faults drawn from a seed.

    Raises BadInput if the pose is not finite or lies in a wall.
    """
    if not all(math.isfinite(x) for x in (s, f, theta)):
        raise BadInput(f"scan: the pose is s = {s} m, f = {f} m, {theta} rad; all must be finite")
    check_free(plant, np.array([s, f]), np.array([s, f]), "scan")
    state = State.start(s, f, 0.0, theta)
    distances = plant.scan_rows(state)
    missing = np.zeros(plant.lidar.rays, dtype=bool)
    drawn = draw_faults(faults, plant, np.arange(1), seed, block_random(seed, 0))
    if drawn is not None:
        missing = drawn.missing(0, state, distances)[:, 0]
        distances = drawn(0, state, distances)
    steering = None if steer is None else float(steer(distances)[0])
    return Scan(state, distances[:, 0], missing, steering)


@style()
def draw_scan(plant: Plant, scan: Scan, title: str, subtitle: str) -> Figure:
    """Draw a car and its scan: rays to the walls, missing ones dashed to the range."""
    view = scan_view(plant, scan)
    figure, axes = new_figure(view, title, subtitle)
    draw_legend(figure, draw_scan_on(axes, plant, scan, view))
    return figure


def _rays(plant: Plant, scan: Scan) -> tuple[tuple[float, float, float], Array]:
    """Return the car's global pose (m, m, rad) and the tips of its rays, ``[rays, 2]``."""
    state = scan.state
    x, y, heading = (
        float(value[0])
        for value in plant.track.to_global(state.frame, state.s, state.f, state.theta)
    )
    angles = heading + plant.lidar.angles
    tips = np.column_stack([np.cos(angles), np.sin(angles)]) * scan.distances[:, None] + (x, y)
    return (x, y, heading), tips


def scan_view(plant: Plant, scan: Scan) -> View:
    """Return a view of a car and all its rays."""
    (x, y, _), tips = _rays(plant, scan)
    return _view(np.vstack([tips, (x, y)]))


def draw_scan_on(axes: Axes, plant: Plant, scan: Scan, view: View) -> list[Artist]:
    """Draw a car and its scan on axes that show ``view``; return the legend's handles."""
    reach = plant.lidar.range
    (x, y, heading), tips = _rays(plant, scan)
    draw_track(axes, plant.track, view)
    far = ~scan.missing & (scan.distances >= reach)
    hit = ~scan.missing & ~far
    thin = float(np.clip(60 / plant.lidar.rays, 0.3, 1.0))
    handles: list[Artist] = []
    for which, color, line, width, face, size, label in (
        (hit, BLUE, "-", thin, BLUE, 3.5 if thin > 0.5 else 1.2, "ray that meets a wall"),
        (far, SKY, ":", thin, None, 0.0, f"no wall within {reach:g} m"),
        (scan.missing, VERMILLION, "--", 1.3, "white", 3.5, f"missing ray, reads {reach:g} m"),
    ):
        if not which.any():
            continue
        rays = [[(x, y), (float(a), float(b))] for a, b in tips[which]]
        axes.add_collection(
            LineCollection(
                rays, colors=color, linestyles=line, lw=width, alpha=min(width, 1.0), zorder=4
            )
        )
        marker = "o" if size else "none"
        dots: dict[str, Any] = {"marker": marker, "color": color, "mfc": face, "mew": 0.8}
        axes.plot(tips[which, 0], tips[which, 1], ls="", ms=size, zorder=5, **dots)
        handles.append(Line2D([], [], ls=line, ms=3.5, label=label, **dots))
    _draw_car(axes, plant, (x, y), heading, scan.steering or 0.0)
    handles.append(Patch(color=WALL, label="wall"))
    return handles


def _view(points: Array) -> View:
    """Return a view of all points that is no more than twice as wide as high, or the reverse."""
    low, high = points.min(axis=0) - FRINGE, points.max(axis=0) + FRINGE
    size = high - low
    spare = np.maximum(size.max() / 2 - size, 0) / 2
    low, high = low - spare, high + spare
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _draw_car(
    axes: Axes, plant: Plant, place: tuple[float, float], heading: float, steering: float
) -> None:
    """Draw the car: its wheelbase is to scale, the front wheels are steered."""
    front, rear = plant.bicycle.front, plant.bicycle.rear
    parts = [(_box(front + rear + 2 * _OVERHANG, _BODY, 0.0, (front - rear) / 2, 0.0), "white")]
    for axle, turn in ((front, steering), (-rear, 0.0)):
        for side in (-_GAUGE / 2, _GAUGE / 2):
            parts.append((_box(_WHEEL, _TYRE, turn, axle, side), INK))
    for corners, color in parts:
        there = _move(corners, heading, *place)
        axes.add_patch(Area(there, facecolor=color, edgecolor=INK, lw=0.8, zorder=7))


def _box(length: float, width: float, angle: float, x: float, y: float) -> Array:
    """Return the corners ``[4, 2]`` of a rectangle turned about its centre (x, y)."""
    corners = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    return _move(corners * (length / 2, width / 2), angle, x, y)


def _move(points: Array, angle: float, x: float, y: float) -> Array:
    """Turn points ``[k, 2]`` about the origin, then shift them by (x, y)."""
    cosine, sine = math.cos(angle), math.sin(angle)
    moved: Array = points @ np.array([[cosine, sine], [-sine, cosine]]) + np.array([x, y])
    return moved

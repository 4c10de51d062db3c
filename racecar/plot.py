"""Traces of many runs over the track, as in Figures 4 and 5 of HSCC 2020."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from racecar.closed_loop import Plant
from racecar.experiment import Outcome
from racecar.figure import (
    BLUE,
    FRINGE,
    INK,
    UNSAFE,
    VERMILLION,
    WALL,
    View,
    draw_legend,
    draw_track,
    new_figure,
    show,
    style,
)
from racecar.polygon import Array
from racecar.safety import Property
from racecar.track import Track

_SAFE_LINE: dict[str, Any] = {"color": BLUE, "ls": "-"}
_CRASHED_LINE: dict[str, Any] = {"color": VERMILLION, "ls": (0, (4, 2))}
_CRASH_MARK: dict[str, Any] = {
    "ls": "", "marker": "X", "ms": 4.5, "mfc": INK, "mec": "white", "mew": 0.4,
}  # fmt: skip

_BEYOND = 8.0  # metres shown beyond the first turn
_INSET = 0.6  # size of the enlarged turn, share of the axes
_INSET_REACH = 0.6  # metres of hall before and after the corner square that it shows


def trace_paths(plant: Plant, outcome: Outcome, points: int = 4) -> tuple[Array, Array]:
    """Return the paths x, y of recorded runs in the global frame, metres.

    Each is ``[runs, 1 + steps * points]``: the start, then ``points`` points on the exact
    arc of each control step, the last at its end; NaN after the end of a run.
    """
    trace = outcome.runs.trace
    if trace is None:
        raise ValueError("the runs were not recorded")
    s, f, v, theta = (trace[name][:, :-1] for name in ("s", "f", "v", "theta"))
    arc, _ = plant.bicycle.arc(s, f, v, theta, trace["steering"], plant.period)
    shares = np.arange(1, points + 1) / points
    s, f = np.stack([arc.point(arc.distance * share) for share in shares], axis=-1)
    frame = np.broadcast_to(trace["frame"][:, :-1, None], s.shape)
    x, y, _ = plant.track.to_global(frame, s, f, 0.0)
    start = outcome.start
    x0, y0, _ = plant.track.to_global(start.frame, start.s, start.f, start.theta)
    runs = len(start)
    return (
        np.column_stack([x0, x.reshape(runs, -1)]),
        np.column_stack([y0, y.reshape(runs, -1)]),
    )


@style()
def draw_traces(
    plant: Plant,
    safety: Property,
    outcome: Outcome,
    title: str,
    subtitle: str,
    whole_track: bool = False,
) -> Figure:
    """Draw recorded runs over the track: the first turn, or the whole track.

    Runs are told apart as the title's share is counted (Outcome.safe).
    """
    track, safe = plant.track, outcome.safe
    paths = trace_paths(plant, outcome)
    starts = paths[0][:, 0], paths[1][:, 0]
    left = track.halls[0].turn == "left"
    view = _whole_view(track) if whole_track else _turn_view(float(starts[0].min()), left)
    figure, axes = new_figure(view, title, subtitle)
    draw_track(axes, track, view, safety)
    draw_runs(axes, paths, safe)
    axes.plot(*starts, "|", color=INK, ms=3, mew=0.6, zorder=5)
    # The driving direction, on the wall beside the start.
    tail, height = starts[0].min(), FRINGE / 2
    axes.annotate(
        "",
        (tail + 1.2, height),
        (tail, height),
        arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.0},
        zorder=5,
    )
    if not whole_track:
        _draw_turn(axes, track, safety, paths, safe, left)
    draw_legend(figure, run_legend(safe, safety))
    return figure


def run_legend(safe: NDArray[np.bool_], safety: Property) -> list[Artist]:
    """Return the handles of a legend for runs of which so many are safe."""
    crashed = int(np.sum(~safe))
    handles: list[Artist] = [
        Line2D([], [], lw=1.4, label=f"safe runs: {len(safe) - crashed}", **_SAFE_LINE)
    ]
    if crashed:
        handles += [
            Line2D([], [], lw=1.4, label=f"crashed runs: {crashed}", **_CRASHED_LINE),
            Line2D([], [], label="crash", **_CRASH_MARK),
        ]
    handles += [
        Patch(color=UNSAFE, label=f"unsafe ({safety.name})"),
        Patch(color=WALL, label="wall"),
    ]
    return handles


def draw_runs(axes: Axes, paths: tuple[Array, Array], safe: NDArray[np.bool_]) -> None:
    """Draw the paths of runs, the crashed ones on top with a mark where they end."""
    width = 0.8 if len(safe) <= 200 else 0.5
    for x, y, is_safe in zip(*paths, safe, strict=True):
        line, layer = (_SAFE_LINE, 3) if is_safe else (_CRASHED_LINE, 4)
        driven = np.isfinite(x)
        axes.plot(x[driven], y[driven], lw=width, alpha=0.7, zorder=layer, **line)
        if not is_safe:
            axes.plot(x[driven][-1], y[driven][-1], zorder=6, **_CRASH_MARK)


def _draw_turn(
    axes: Axes,
    track: Track,
    safety: Property,
    paths: tuple[Array, Array],
    safe: NDArray[np.bool_],
    left: bool,
) -> None:
    """Show the first turn larger, on the inner block."""
    back, edge = -track.width - _INSET_REACH, 0.1
    if left:
        view, bottom, note = (back, edge, -track.width - edge, _INSET_REACH), 0.94 - _INSET, 0.93
    else:
        view, bottom, note = (back, edge, back, edge), 0.06, 0.04
    inset = axes.inset_axes((0.8 - _INSET, bottom, _INSET, _INSET))
    show(inset, view)
    inset.set_anchor("NE" if left else "SE")
    inset.set_xticks([])
    inset.set_yticks([])
    draw_track(inset, track, view, safety)
    draw_runs(inset, paths, safe)
    inset.text(0.04, note, "enlarged", transform=inset.transAxes, fontsize=8, zorder=7)
    x0, x1, y0, y1 = view
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, ec=INK, lw=0.7, zorder=7))


def _whole_view(track: Track) -> View:
    halls = np.arange(len(track.halls))
    lengths = np.array([hall.length for hall in track.halls])
    near = track.to_global(halls, np.zeros(len(halls)), np.zeros(len(halls)), 0.0)
    far = track.to_global(halls, np.full(len(halls), track.width), lengths, 0.0)
    x, y = np.concatenate([near[0], far[0]]), np.concatenate([near[1], far[1]])
    return x.min() - FRINGE, x.max() + FRINGE, y.min() - FRINGE, y.max() + FRINGE


def _turn_view(start: float, left: bool) -> View:
    """Return a view from the start to well beyond the first turn, to whichever side it goes."""
    low, high = (-2.0, _BEYOND) if left else (-_BEYOND, FRINGE)
    return start - FRINGE, FRINGE, low, high

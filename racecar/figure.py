"""What all figures share: canvas, colours, the track, and how they are saved.

Everything is drawn in the global frame: the first hall runs along +x, and the corner of
its left and front wall is the origin. Figures are made without pyplot, so that nothing
depends on a display or on a user's settings, and the same figure gives the same bytes.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Area
from matplotlib.ticker import MaxNLocator

from racecar.controller import write_whole
from racecar.errors import BadInput
from racecar.polygon import Array, Polygon
from racecar.safety import Property
from racecar.track import Track

FORMATS = (".png", ".svg")

# Okabe and Ito's colours: they stay apart for colour-blind readers and in grey.
BLUE, SKY, VERMILLION = "#0072B2", "#56B4E9", "#D55E00"
WALL, UNSAFE, INK = "#B8B8B8", "#F8E7C8", "#222222"

#: Metres of wall shown around what matters.
FRINGE = 0.5

#: x0, x1, y0, y1 in metres.
View = tuple[float, float, float, float]


def check_format(path: Path) -> None:
    """Raise BadInput if a figure cannot be written under this name."""
    if path.suffix.lower() not in FORMATS:
        raise BadInput(f"{path}: figures are written as {' or '.join(FORMATS)}; name it so")


@contextmanager
def style() -> Iterator[None]:
    """Set matplotlib's own defaults, whatever the user's are, and ids that do not vary."""
    with matplotlib.style.context({"svg.hashsalt": "closedlap"}, after_reset=True):
        yield


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG by its name, whole or not at all, with no date in it."""
    check_format(path)
    kind = path.suffix.lower()[1:]
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    buffer = io.BytesIO()
    with style():
        figure.savefig(
            buffer, format=kind, dpi=200, metadata=metadata, bbox_inches="tight", pad_inches=0.06
        )
    write_whole(path, buffer.getvalue())


def new_figure(view: View, title: str, subtitle: str) -> tuple[Figure, Axes]:
    """Return an empty figure whose axes show ``view`` at one scale for x and y."""
    width, height = view[1] - view[0], view[3] - view[2]
    inches = 6.4
    figure = Figure(figsize=(inches, inches * height / width + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    show(axes, view)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=7, integer=True, steps=[1, 2, 5, 10]))
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_title(f"{title}\n", fontsize=11)
    axes.text(
        0.5, 1.015, subtitle, transform=axes.transAxes, ha="center", va="bottom", fontsize=8.5
    )
    return figure, axes


def new_panels(views: Sequence[View], title: str, columns: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with one panel per view, in rows of at most ``columns``."""
    columns = min(columns, len(views))
    rows = -(-len(views) // columns)
    width = max(3.2, 9.6 / columns)
    tallest = max((v[3] - v[2]) / (v[1] - v[0]) for v in views)
    figure = Figure(
        figsize=(columns * width, rows * (width * tallest + 0.55) + 0.7), layout="constrained"
    )
    FigureCanvasAgg(figure)
    panels = []
    for place, view in enumerate(views):
        axes = figure.add_subplot(rows, columns, place + 1)
        show(axes, view)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(nbins=5, integer=True))
        axes.tick_params(labelsize=7)
        if place % columns == 0:
            axes.set_ylabel("y (m)", fontsize=8)
        if place >= len(views) - columns:
            axes.set_xlabel("x (m)", fontsize=8)
        panels.append(axes)
    figure.suptitle(title, fontsize=11)
    return figure, panels


def show(axes: Axes, view: View) -> None:
    """Let axes show exactly ``view``, at one scale for x and y."""
    axes.set_xlim(view[0], view[1])
    axes.set_ylim(view[2], view[3])
    axes.set_aspect("equal")


def draw_track(axes: Axes, track: Track, view: View, safety: Property | None = None) -> None:
    """Fill the walls and, beside them, the unsafe zone of a property."""
    x0, x1, y0, y1 = view
    if safety is not None:
        # The first hall's frame knows all polygons; in it s = -y and f = -x.
        for polygon in safety.unsafe[0]:
            corners = clip(polygon, np.array([-y1, -x1]), np.array([-y0, -x0]))
            if len(corners) > 2:
                axes.add_patch(Area(-corners[:, ::-1], color=UNSAFE, lw=0, zorder=1))
    for wall in track.walls:
        corners = clip(wall, np.array([x0, y0]), np.array([x1, y1]))
        if len(corners) > 2:
            axes.add_patch(Area(corners, color=WALL, lw=0, zorder=2))


def draw_legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Draw the legend in one row below the axes, where it hides nothing."""
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles),
        fontsize=8,
        columnspacing=1.4,
        frameon=False,
    )


def clip(polygon: Polygon, lower: Array, upper: Array) -> Array:
    """Return the corners ``[k, 2]`` of a polygon within a box; k is 0 if they do not meet.

    One half-plane after the other cuts the box (Sutherland and Hodgman 1974).
    """
    (a0, b0), (a1, b1) = lower, upper
    corners = [np.array(corner) for corner in ((a0, b0), (a1, b0), (a1, b1), (a0, b1))]
    for normal, offset in zip(polygon.normals, polygon.offsets, strict=True):
        kept = []
        for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
            at_p, at_q = normal @ p - offset, normal @ q - offset
            if at_p <= 0:
                kept.append(p)
            if at_p * at_q < 0:
                kept.append(p + (q - p) * (at_p / (at_p - at_q)))
        corners = kept
    return np.array(corners).reshape(-1, 2)

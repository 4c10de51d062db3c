"""The figures of the data card, and the numbers that each of them shows."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from generator.card.facts import Dataset
from generator.categories import CATEGORIES
from generator.piece import FOLDER
from generator.tree import TRACES
from racecar.figure import (
    BLUE,
    INK,
    SKY,
    VERMILLION,
    View,
    draw_legend,
    draw_track,
    new_panels,
    style,
)
from racecar.safety import named_property
from racecar.track import square_track

#: The first turn, from 6 m before to 6 m behind it: x0, x1, y0, y1 in the global frame.
_TURN: View = (-6.0, 0.3, -6.0, 0.3)
#: Every so many of the reference traces are drawn.
_EVERY = 4
_COLOURS = {"unsat": BLUE, "sat": VERMILLION, "unknown": INK}


@dataclass(frozen=True)
class Picture:
    """A figure: the file's name, the numbers it shows, and how it is drawn from them.

    Reals are rounded, so that the numbers are the same wherever they are made from the same files.
    """

    name: str
    data: Any
    draw: Callable[[Any], Figure]

    @property
    def digest(self) -> str:
        """The sha256 of the numbers."""
        text = json.dumps(self.data, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()


def pictures(root: Path, dataset: Dataset) -> list[Picture]:
    """Return the figures that can be drawn of a dataset.

    Traces and simulated margins need reference traces, the difficulty reference results.
    """
    paths, margins = _read_traces(root, [file.name for file in dataset.controllers])
    found = []
    if paths:
        found.append(Picture("traces.png", {"paths": paths, "margins": margins}, _draw_traces))
        proved = {name: _proved(dataset, name) for name in margins}
        data = {
            name: {"simulated": margins[name], "bracket": proved[name]} for name in sorted(margins)
        }
        found.append(Picture("margins.svg", data, _draw_margins))
    known = _known_margins(dataset)
    if known:
        found.append(Picture("categories.svg", known, _draw_categories))
    times = _times(dataset)
    if times:
        found.append(Picture("difficulty.svg", times, _draw_difficulty))
    return found


def _read_traces(root: Path, names: list[str]) -> tuple[dict[str, Any], dict[str, list[float]]]:
    """Return x and y (m) of some runs, and the margins (m) of all, by controller."""
    track, paths, margins = square_track(), {}, {}
    for table in sorted((root / FOLDER).glob(f"*/{TRACES}")):
        with h5py.File(table) as file:
            for name in set(names) & set(file):
                group = file[name]
                driven = np.isfinite(group["steering"][()])
                there = np.column_stack([np.ones(len(driven), dtype=bool), driven])
                frame, s, f, theta = (group[x][()] for x in ("frame", "s", "f", "theta"))
                x, y, _ = track.to_global(frame, s, f, theta)
                paths[name] = [
                    np.round(np.stack([x[i, there[i]], y[i, there[i]]]), 3).tolist()
                    for i in range(0, len(x), _EVERY)
                ]
                margins[name] = np.round(group["clearance/run"][()], 4).tolist()
    return dict(sorted(paths.items())), margins


def _proved(dataset: Dataset, controller: str) -> list[float | None]:
    """Return the reference bracket of the whole range, property clearance: lower and upper."""
    for category in dataset.categories:
        for asked in category.instances:
            if asked.id == f"{controller}.{category.name}.clearance" and asked.known:
                return [asked.known.lower, asked.known.upper]
    return [None, None]


def _known_margins(dataset: Dataset) -> dict[str, dict[str, list[float]]]:
    """Return proved margins of unsat and margins of sat witnesses (m), by category.

    Those of VNN-LIB questions are left out: they have no common unit.
    """
    found = {
        category.name: {
            "unsat": [
                round(x.lower, 4)
                for x in category.results
                if x.verdict == "unsat" and x.lower is not None
            ],
            "sat": [
                round(x.upper, 4)
                for x in category.results
                if x.verdict == "sat" and x.upper is not None
            ],
        }
        for category in dataset.categories
        if category.name not in CATEGORIES or CATEGORIES[category.name].make is None
    }
    return {name: margins for name, margins in found.items() if any(margins.values())}


def _times(dataset: Dataset) -> list[dict[str, Any]]:
    """Return what is drawn of every instance that has a reference result with a time."""
    sizes = {file.name: (file.controller.rays, file.parameters) for file in dataset.controllers}
    return [
        {
            "verdict": asked.known.verdict,
            "seconds": round(asked.known.seconds, 3),
            "rays": sizes[asked.controller][0],
            "parameters": sizes[asked.controller][1],
            "width": None if math.isnan(asked.width) else asked.width,
        }
        for category in dataset.categories
        for asked in category.instances
        if asked.known and asked.known.seconds is not None and asked.controller in sizes
    ]


@style()
def _draw_traces(data: dict[str, Any]) -> Figure:
    track, paths = square_track(), data["paths"]
    safety = named_property("clearance", track)
    figure, panels = new_panels([_TURN] * len(paths), "Reference traces, first turn", 5)
    for axes, (name, runs) in zip(panels, paths.items(), strict=True):
        draw_track(axes, track, _TURN, safety)
        axes.set_title(name, fontsize=7)
        for (x, y), margin in zip(runs, data["margins"][name][::_EVERY], strict=True):
            axes.plot(x, y, color=BLUE if margin > 0 else VERMILLION, lw=0.7, zorder=3)
    return figure


@style()
def _draw_margins(data: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(7.2, 0.9 + 0.19 * len(data)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    names = list(data)[::-1]
    marks: dict[str, Any] = {}
    for row, name in enumerate(names):
        runs = data[name]["simulated"]
        (marks["simulated, 21 starts"],) = axes.plot(
            runs, [row] * len(runs), "|", color=SKY, ms=7, mew=1
        )
        lower, upper = data[name]["bracket"]
        for value, label, mark, colour in (
            (lower, "proved for all starts", ">", BLUE),
            (upper, "worst witness found", "<", VERMILLION),
        ):
            if value is not None:
                (marks[label],) = axes.plot(value, row, mark, color=colour, ms=5)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.axvline(0, color=INK, lw=0.8)
    axes.grid(axis="x", lw=0.3)
    axes.set_xlabel("least margin of the property clearance in 7 s (m)")
    axes.set_title("Margins over the 20 cm start range", fontsize=11)
    for label, mark in marks.items():
        mark.set_label(label)
    draw_legend(figure, list(marks.values()))
    return figure


@style()
def _draw_categories(data: dict[str, Any]) -> Figure:
    columns = min(4, len(data))
    rows = -(-len(data) // columns)
    figure = Figure(figsize=(2.4 * columns, 0.9 + 1.7 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for place, (name, margins) in enumerate(data.items()):
        axes = figure.add_subplot(rows, columns, place + 1)
        both = [100 * np.array(margins[verdict]) for verdict in ("unsat", "sat")]
        axes.hist(both, bins=20, stacked=True, color=[BLUE, VERMILLION], label=["unsat", "sat"])
        axes.axvline(0, color=INK, lw=0.8)
        axes.set_title(name, fontsize=8)
        axes.tick_params(labelsize=7)
    figure.supylabel("instances", fontsize=9)
    title = "Distribution of margins, cm (unsat: proved; sat: of the witness)"
    figure.suptitle(title, fontsize=11)
    draw_legend(figure, list(figure.axes[0].get_legend_handles_labels()[0]))
    return figure


@style()
def _draw_difficulty(rows: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 3, sharey=True)
    about = (
        ("rays", "LiDAR rays", 1),
        ("parameters", "parameters of the network", 1),
        ("width", "width of the start range (mm)", 1000),
    )
    for axes, (key, label, scale) in zip(panels, about, strict=True):
        for verdict, colour in _COLOURS.items():
            points = [
                (row[key] * scale, max(row["seconds"], 0.01))
                for row in rows
                if row["verdict"] == verdict and row[key]
            ]
            _scatter(axes, points, colour, verdict)
        axes.set_xscale("log")
        _label_decades(axes.xaxis)
        axes.set_xlabel(label, fontsize=9)
        axes.grid(lw=0.3)
    panels[0].set_yscale("log")
    panels[0].yaxis.set_major_locator(LogLocator(numticks=12))
    panels[0].set_ylabel("time of the reference verifier (s)", fontsize=9)
    figure.suptitle("Difficulty: time against rays, network size and width", fontsize=11)
    draw_legend(figure, list(panels[0].get_legend_handles_labels()[0]))
    return figure


def _label_decades(axis: Axis) -> None:
    """Label 1, 2 and 5 times powers of ten with plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}" if x < 10_000 else f"{x:,.0f}"))
    axis.set_minor_formatter(NullFormatter())


def _scatter(axes: Axes, points: list[tuple[float, float]], colour: str, label: str) -> None:
    """Draw points, those at one place apart by a few percent, the same ones every time."""
    random = np.random.default_rng(0)
    x, y = np.array(points, dtype=float).reshape(-1, 2).T
    x = x * np.exp(random.uniform(-0.06, 0.06, len(x)))
    # Thousands of marks are one picture: in an SVG they would be megabytes.
    axes.plot(x, y, ".", color=colour, ms=3, alpha=0.5, label=label, rasterized=True)

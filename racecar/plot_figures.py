"""The paper's figures for any controllers: traces side by side, and two scans.

Figure 4 shows traces without faults and Figure 5 the same runs with the paper's faults, one
panel per controller; Figure 3 shows a scan in the modified and in the unmodified environment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from racecar.closed_loop import Plant
from racecar.experiment import Outcome
from racecar.figure import FRINGE, INK, draw_legend, draw_track, new_panels, style
from racecar.plot import draw_runs, run_legend, trace_paths
from racecar.plot_scan import Scan, draw_scan_on
from racecar.safety import Property

#: Metres shown before, and beyond, the corner.
_BEFORE, _BEYOND = 11.0, 7.0
_COLUMNS = 4
#: What Figure 3 shows: the corner; missing rays leave the picture.
_CORNER = (-3.3, 2.2, -5.2, 1.3)


@dataclass(frozen=True)
class Panel:
    """One controller's runs, recorded."""

    name: str
    outcome: Outcome


@style()
def draw_controllers(plant: Plant, safety: Property, panels: list[Panel], title: str) -> Figure:
    """Draw the runs of several controllers side by side (Figures 4 and 5)."""
    view = (-_BEFORE, FRINGE, -_BEYOND, FRINGE)
    figure, places = new_panels([view] * len(panels), title, _COLUMNS)
    for axes, panel in zip(places, panels, strict=True):
        draw_track(axes, plant.track, view, safety)
        paths, safe = trace_paths(plant, panel.outcome), panel.outcome.safe
        draw_runs(axes, paths, safe)
        axes.plot(paths[0][:, 0], paths[1][:, 0], "|", color=INK, ms=3, mew=0.6, zorder=5)
        share = f"{int(safe.sum())} of {len(safe)} safe"
        axes.set_title(f"{panel.name}\n{share}", fontsize=8)
    every = np.concatenate([panel.outcome.safe for panel in panels])
    draw_legend(figure, run_legend(every, safety))
    return figure


@style()
def draw_scans(plant: Plant, scans: dict[str, Scan], title: str) -> Figure:
    """Draw scans at the same pose side by side (Figure 3); scans: by the panel's heading."""
    figure, places = new_panels([_CORNER] * len(scans), title, _COLUMNS)
    handles = {}
    for axes, (heading, scan) in zip(places, scans.items(), strict=True):
        for handle in draw_scan_on(axes, plant, scan, _CORNER):
            handles[handle.get_label()] = handle
        axes.set_title(f"{heading}\n{int(scan.missing.sum())} rays missing", fontsize=9)
    draw_legend(figure, list(handles.values()))
    return figure

"""Pictures of plots. They need matplotlib, see `rack.tools.console.pictures`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rack.tools.console.pictures import open_figure
from rack.tools.plots.curves import Mark, Plot, SignalPanel, build_panels, group_marks

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

MARK_COLOURS = {
    "fault": "#CC3311",
    "detection": "#EE7733",
    "miss": "#AA3377",
    "hold": "#DDAA33",
    "lost": "#000000",
    "restart": "#009988",
    "trigger": "#33BBEE",
}


def draw_panel(
    axes: Axes, panel: SignalPanel, groups: Mapping[str, list[Mark]], end_s: float
) -> list[Artist]:
    """Draw a panel and the marks.

    Args:
        axes: Axes to draw on.
        panel: The panel.
        groups: Marks by their entry in the legend.
        end_s: Time up to which the last values are drawn.

    Returns:
        Entries of the marks for a legend.
    """
    colours: dict[str, str] = {}
    first, *_ = panel.curves.values()
    for label, series in panel.curves.items():
        # Equal signals of both runs have equal colours.
        colour = colours.setdefault(series.name, f"C{len(colours)}")
        axes.step(
            np.append(series.time_s, end_s),
            np.append(series.values, series.values[-1:]),
            colour + ("-" if series.run == first.run else "--"),
            where="post",
            label=label,
        )
    axes.set_ylabel(panel.label)
    if panel.states:
        names, numbers = zip(*panel.states, strict=True)
        axes.set_yticks(numbers, names)
    entries: list[Artist] = []
    for entry, marks in groups.items():
        kind = marks[0].kind
        artist = axes.broken_barh(
            [(mark.time_s, mark.until_s - mark.time_s) for mark in marks],
            # There may be hundreds of missed cycles.
            (0, 0.06 if kind == "miss" else 1.0),
            transform=axes.get_xaxis_transform(),
            color=MARK_COLOURS[kind],
            alpha=0.2 if kind == "hold" else 1.0,
            label=entry,
        )
        entries.append(artist)
    return entries


def save_plot(plot: Plot, path: Path) -> None:
    """Save a plot as PNG or SVG, depending on the suffix of the path."""
    panels = build_panels(plot.series)
    groups = group_marks(plot.marks)
    with open_figure([path], 10.0, 2.6 * len(panels) + 0.2 * len(groups) + 0.8) as figure:
        rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
        for axes, panel in zip(rows[:, 0], panels, strict=True):
            entries = draw_panel(axes, panel, groups, plot.window_s[1])
            axes.set_xlim(*plot.window_s)
            if len(curves := axes.get_lines()) > 1:
                axes.legend(
                    handles=curves, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False
                )
        rows[-1, 0].set_xlabel("simulated time, s")
        figure.suptitle(plot.title)
        if entries:
            figure.legend(handles=entries, loc="outside lower left", frameon=False)

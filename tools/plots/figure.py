"""Pictures of plots. They need matplotlib, see `rack.tools.console.pictures`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rack.tools.console.pictures import open_figure
from rack.tools.plots.curves import Plot, SignalPanel, build_panels
from rack.tools.plots.marks import Mark, group_marks

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
    "first difference": "#0077BB",
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
    run, style = panel.series[0].run, "-"
    for series in panel.series:
        if series.run != run:
            run, style = series.run, "--"
            # Equal signals of both runs have equal colours.
            axes.set_prop_cycle(None)
        times = np.append(series.time_s, end_s)
        for label, values in series.list_curves(panel.is_alone):
            axes.step(times, np.append(values, values[-1:]), style, where="post", label=label)
    axes.set_ylabel(panel.label)
    if states := panel.series[0].signal.spec.values:
        names, numbers = zip(*states, strict=True)
        axes.set_yticks(numbers, names)
    entries: list[Artist] = []
    for entry, marks in groups.items():
        colour = MARK_COLOURS[marks[0].kind]
        if marks[0].kind == "hold":
            spans = [(mark.time_s, mark.until_s - mark.time_s) for mark in marks]
            artist: Artist = axes.broken_barh(
                spans, (0, 1), transform=axes.get_xaxis_transform(), color=colour, alpha=0.2
            )
        else:
            times_s = [mark.time_s for mark in marks]
            # There may be hundreds of missed cycles.
            top = 0.06 if marks[0].kind == "miss" else 1.0
            height = axes.get_xaxis_transform()
            artist = axes.vlines(times_s, 0.0, top, colour, "--", transform=height)
        artist.set_label(entry)
        entries.append(artist)
    return entries


def save_plot(plot: Plot, path: Path) -> None:
    """Save a plot as PNG or SVG, depending on the suffix of the path."""
    panels = build_panels(plot.series)
    groups = group_marks(plot.marks)
    with open_figure(
        [path], 10.0, 2.6 * len(panels) + 0.2 * len(groups) + 0.8, layout="constrained"
    ) as figure:
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

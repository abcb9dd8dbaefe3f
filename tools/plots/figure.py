"""Pictures of plots. They need matplotlib, see `rack.tools.console.pictures`."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rack.tools.console.pictures import open_figure
from rack.tools.plots.curves import Panel, Plot, build_panels
from rack.tools.plots.marks import MAX_LEGEND_ENTRIES, MarkGroup, MarkKind, group_marks

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

WIDTH_IN = 10.0
PANEL_IN = 2.6
LEGEND_LINE_IN = 0.19
MARK_COLOURS: dict[MarkKind, str] = {
    "fault": "#CC3311",
    "detection": "#EE7733",
    "miss": "#AA3377",
    "hold": "#DDAA33",
    "lost": "#000000",
    "restart": "#009988",
    "first difference": "#0077BB",
    "trigger": "#33BBEE",
}
MISS_HEIGHT = 0.06
"""Height of the mark of a missed cycle, as a fraction of the axes. There may be hundreds."""
HOLD_ALPHA = 0.2


def draw_panel(
    axes: Axes, panel: Panel, groups: Sequence[MarkGroup], end_s: float | None = None
) -> list[Artist]:
    """Draw the curves of a panel and the marks.

    Args:
        axes: Axes to draw on.
        panel: The panel.
        groups: The marks.
        end_s: End of the axis of time. The last values are drawn up to it. None for the time of
            the last message.

    Returns:
        Entries of the marks for a legend.
    """
    for curve in panel.curves:
        times, values = curve.time_s, curve.values
        if end_s is not None:
            times, values = np.append(times, end_s), np.append(values, values[-1])
        look = f"C{curve.number % 10}{'--' if curve.is_other else '-'}"
        axes.step(times, values, look, where="post", label=curve.label, linewidth=1.2)
    axes.set_ylabel(panel.label)
    if panel.names:
        names, numbers = zip(*panel.names, strict=True)
        axes.set_yticks(numbers, names)
    entries: list[Artist] = []
    height = axes.get_xaxis_transform()
    for group in groups:
        colour = MARK_COLOURS[group.kind]
        if group.kind == "hold":
            last_s = axes.dataLim.x1 if end_s is None else end_s
            for mark in group.marks:
                axes.axvspan(
                    mark.time_s,
                    mark.find_end_s(last_s),
                    color=colour,
                    alpha=HOLD_ALPHA,
                    linewidth=0,
                )
            entry: Artist = axes.fill_between([], [], color=colour, alpha=HOLD_ALPHA)
        else:
            times_s = [mark.time_s for mark in group.marks]
            top = MISS_HEIGHT if group.kind == "miss" else 1.0
            entry = axes.vlines(times_s, 0.0, top, colour, "--", transform=height, linewidth=1.2)
        entry.set_label(group.label)
        entries.append(entry)
    return entries


def save_plot(plot: Plot, path: Path) -> None:
    """Save a plot as PNG or SVG, depending on the suffix of the path."""
    panels = build_panels(plot.series)
    groups = group_marks(plot.marks)
    height = PANEL_IN * len(panels) + LEGEND_LINE_IN * len(groups) + 0.8
    with open_figure([path], WIDTH_IN, height, layout="constrained") as figure:
        rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
        for axes, panel in zip(rows[:, 0], panels, strict=True):
            entries = draw_panel(axes, panel, groups, plot.window_s[1])
            axes.set_xlim(*plot.window_s)
            axes.grid(alpha=0.3)
            if len(panel.curves) > 1 or panel.curves[0].label not in panel.label:
                columns = ceil(len(panel.curves) / MAX_LEGEND_ENTRIES)
                curves = axes.get_lines()
                axes.legend(
                    handles=curves,
                    loc="center left",
                    bbox_to_anchor=(1.0, 0.5),
                    ncols=columns,
                    fontsize=8,
                    frameon=False,
                )
        rows[-1, 0].set_xlabel("simulated time, s")
        figure.suptitle(plot.title, fontsize=11)
        if entries:
            figure.legend(handles=entries, loc="outside lower left", fontsize=8, frameon=False)

"""Picture of a Gantt chart. It imports matplotlib, see `rack.tools.console.pictures`."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from rack.boards.timing.tasks import Unit
from rack.tools.console.pictures import list_picture_paths, open_figure
from rack.tools.console.tables import format_ms
from rack.tools.timing.charts.letters import MAX_COLUMNS, choose_frame_labels, choose_label_times
from rack.tools.timing.charts.panel import Panel

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from rack.tools.timing.charts.patterns import Lane

UNIT_COLOURS = {
    Unit.EXCHANGE: "#BBCC33",
    Unit.READ: "#77AADD",
    Unit.PROCESS: "#EE8866",
    Unit.WRITE: "#EEDD88",
    Unit.PLAN: "#44BB99",
    Unit.UPDATE: "#FFAABB",
}
"""Light colours for black letters, which colour-blind readers can distinguish (Paul Tol)."""
EDGE_PT = 0.2
LATE_COLOUR = "#CC3311"
GRID_COLOUR = "#555555"
BACKGROUND_COLOUR = "#F3F3F3"
FRAME_COLOUR = "#999999"
WIDTH_IN = 10.0
LANE_IN = 0.55
LEGEND_COLUMNS = 7
BAR_HEIGHT = 0.66
# Sizes of letters. A short span has a smaller letter, and a very short one has none.
LETTER_PT = 9.0
MIN_LETTER_PT = 5.0
LETTER_POINT_FRACTION = 1 / 520
"""Fraction of the window's length that a letter needs for each point of its size.

The letter W is as wide as it is high, and has a margin on both sides.
"""
MIN_CYCLE_FRACTION = 0.024
"""Fraction of the window above which the start of a cycle is marked."""
CHARACTER_FRACTION = 1 / 120
"""Fraction of the window that a character of a frame's label takes."""


def save_picture(panels: Sequence[Panel], title: str, stem: Path) -> list[Path]:
    """Draw panels, one above the other on one axis of time.

    Args:
        panels: Panels to draw.
        title: Title of the picture.
        stem: Path of the pictures without .png and .svg.

    Returns:
        Paths of the pictures.
    """
    lanes = [len(panel.lanes) for panel in panels]
    height = LANE_IN * sum(lanes) + 0.45 * len(panels) + 1.2
    paths = list_picture_paths(stem)
    with open_figure(paths, WIDTH_IN, height) as figure:
        rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=lanes)
        for axes, panel in zip(rows[:, 0], panels, strict=True):
            draw_panel(axes, panel)
        rows[-1, 0].set_xlabel("time, ms")
        used = {span.unit for panel in panels for span in panel.chart.spans}
        handles: list[Artist] = [
            Patch(facecolor=UNIT_COLOURS[unit], label=f"{unit.value}  {unit.name.lower()}")
            for unit in Unit
            if unit in used
        ]
        if any(panel.list_late_jobs(lane) for panel in panels for lane in panel.lanes):
            handles.append(Line2D([], [], marker="v", color=LATE_COLOUR, label="missed deadline"))
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=ceil(len(handles) / ceil(len(handles) / LEGEND_COLUMNS)),
            fontsize=8,
            frameon=False,
        )
        figure.suptitle(title, fontsize=11)
    return paths


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw one panel with the first lane on top. The axis is in ns, with labels in ms."""
    chart = panel.chart
    count = len(panel.lanes)
    for row, lane in enumerate(panel.lanes):
        _draw_lane(axes, panel, lane, count - 1 - row)
    if panel.frames:
        starts = list(panel.frames.values())
        axes.vlines(
            starts, -0.5, count - 0.5, colors=FRAME_COLOUR, linewidth=0.8, linestyles="dashed"
        )
        character_ns = round(CHARACTER_FRACTION * (chart.end_ns - chart.start_ns))
        for number, start in choose_frame_labels(panel, character_ns, "frame "):
            position = (start, count - 0.5)
            axes.annotate(f"frame {number}", position, fontsize=7, va="bottom", color=GRID_COLOUR)
    axes.set_xlim(chart.start_ns, chart.end_ns)
    axes.set_ylim(-0.5, count - 0.5)
    # Space the labels as in a chart in letters, which has the same width.
    times = choose_label_times(panel, (chart.end_ns - chart.start_ns) // MAX_COLUMNS)
    axes.set_xticks(times, [format_ms(time) for time in times])
    axes.set_yticks(range(count), [lane.title for lane in reversed(panel.lanes)])
    axes.tick_params(left=False)
    axes.set_title(panel.kind, fontsize=9, loc="left", pad=14 if panel.frames else None)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _draw_lane(axes: Axes, panel: Panel, lane: Lane, row: int) -> None:
    """Draw the spans, cycle starts and late jobs of a lane in a row."""
    chart = panel.chart
    low = row - BAR_HEIGHT / 2
    window_ns = chart.end_ns - chart.start_ns
    axes.broken_barh([(chart.start_ns, window_ns)], (low, BAR_HEIGHT), facecolors=BACKGROUND_COLOUR)
    lane_spans = [span for span in chart.spans if span.task in lane.tasks]
    for unit in Unit:
        bars = [(s.start_ns, s.end_ns - s.start_ns) for s in lane_spans if s.unit is unit]
        axes.broken_barh(bars, (low, BAR_HEIGHT), color=UNIT_COLOURS[unit], linewidth=EDGE_PT)
    for span in lane_spans:
        size = min((span.end_ns - span.start_ns) / window_ns / LETTER_POINT_FRACTION, LETTER_PT)
        if size >= MIN_LETTER_PT:
            middle_ns = (span.start_ns + span.end_ns) / 2
            axes.text(middle_ns, row, span.unit.value, ha="center", va="center", fontsize=size)
    if lane.cycle_ns >= MIN_CYCLE_FRACTION * window_ns:
        starts = lane.list_cycle_starts(chart.start_ns, chart.end_ns + 1)
        axes.vlines(
            list(starts), low - 0.1, low + BAR_HEIGHT + 0.1, colors=GRID_COLOUR, linewidth=0.9
        )
    height = low + BAR_HEIGHT + 0.06
    # Mark each missed deadline, and the time from the deadline to the end of the job.
    for job in panel.list_late_jobs(lane):
        start_ns = max(job.deadline_ns, chart.start_ns)
        if start_ns == job.deadline_ns:
            axes.plot(start_ns, height, "v", markersize=6, color=LATE_COLOUR, clip_on=False)
        if job.end_ns is not None:
            end_ns = min(job.end_ns, chart.end_ns)
            axes.hlines(height, start_ns, end_ns, colors=LATE_COLOUR, linewidth=1.6)

"""Plots as text for a terminal. They need plotext, which is imported when a plot is drawn."""

from __future__ import annotations

from string import ascii_uppercase, digits
from typing import TYPE_CHECKING

import numpy as np

from rack.tools.plots.curves import Plot, Series, build_panels, group_marks

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

NO_CURVES = "no curves without plotext: pip install 'nasrem-rack[live]'"
COLOURS = (4, 2, 1, 6, 5, 3, 12, 10, 9, 14)
"""Numbers of the terminal's own colours, which suit dark and light backgrounds."""
MARKERS = digits + ascii_uppercase[::-1]
"""Markers of curves where there are no colours."""
MIN_HEIGHT = 7
"""Smallest height of a panel, in lines."""


def draw_plot(plot: Plot, console: Console, height: int) -> Text:
    """Draw the panels of a plot, one above the other, each with its legend, and list the marks.

    The first letters of the list are at the times of the marks.

    Args:
        plot: The plot.
        console: Console with the width and the colours.
        height: Height in lines. The plot is higher if that is not enough for its panels.

    Raises:
        ImportError: plotext is not installed.
    """
    import plotext
    from rich.text import Text

    has_colours = console.color_system is not None and not console.no_color
    groups = [*zip(ascii_uppercase, group_marks(plot.marks).items(), strict=False)]
    panels = build_panels(plot.series)
    rows = height - 2 * len(groups) - 1
    pieces: list[Text] = []
    for panel in panels:
        plotext.clear_figure()
        # Use the colours of the terminal.
        plotext.theme("clear")
        plotext.plotsize(console.width, max(rows // len(panels) - 2, MIN_HEIGHT))
        legend = Text()
        lows = []
        for number, (label, series) in enumerate(panel.curves.items()):
            is_clear = has_colours or len(panel.curves) == 1
            marker = "braille" if is_clear else MARKERS[number % len(MARKERS)]
            colour = COLOURS[number % len(COLOURS)]
            points = _list_points(series, plot.window_s, console.width)
            lows += points[1]
            plotext.plot(*points, marker=marker, color=colour if has_colours else None)
            sign = "⠤⠤" if marker == "braille" else marker
            legend.append(f"{sign} {label}  ", f"color({colour})")
        if panel.states:
            names, numbers = zip(*panel.states, strict=True)
            plotext.yticks(numbers, names)
        # The letter of the earlier mark covers the others.
        for letter, (_, marks) in reversed(groups):
            for mark in marks:
                ends = np.clip((mark.time_s, mark.until_s), *plot.window_s).tolist()
                plotext.plot(ends, [min(lows, default=0.0)] * 2, marker=letter, color=None)
                # There may be hundreds of missed cycles.
                if mark.kind not in ("hold", "miss"):
                    plotext.vline(ends[0])
        plotext.xlim(*plot.window_s)
        pieces += [Text(panel.label), Text.from_ansi(plotext.build().rstrip("\n"))]
        pieces += [legend] * (len(panel.curves) > 1)
    pieces.append(Text("simulated time, s".rjust(console.width)))
    return Text("\n").join([*pieces, *(Text(f"{letter} {entry}") for letter, (entry, _) in groups)])


def _list_points(
    series: Series, window_s: tuple[float, float], width: int
) -> tuple[list[float], list[float]]:
    """Return the points of a curve in a window: its steps, reduced to what the width can show."""
    is_finite = np.isfinite(series.values)
    # A value holds until the next one.
    times = np.repeat(np.append(series.time_s[is_finite].clip(*window_s), window_s[1]), 2)[1:-1]
    numbers = np.repeat(series.values[is_finite].astype(float), 2)
    if (size := len(times) // (4 * width)) > 1:
        buckets = numbers[: len(numbers) // size * size].reshape(-1, size)
        numbers = np.column_stack((buckets.min(axis=1), buckets.max(axis=1))).ravel()
        times = np.repeat(times[: len(times) // size * size : size], 2)
    return times.tolist(), numbers.tolist()

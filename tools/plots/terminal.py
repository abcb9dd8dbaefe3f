"""Plots as text for a terminal. They need plotext, which is imported when a plot is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, isclose, log10
from string import ascii_lowercase, ascii_uppercase, digits
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rack.tools.plots.curves import Curve, Panel
from rack.tools.plots.marks import Mark, MarkGroup, MarkKind, group_marks

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

NO_CURVES = "no curves without plotext: pip install 'nasrem-rack[live]'"
CURVE_COLOURS = (4, 2, 1, 6, 5, 3, 12, 10, 9, 14)
"""Numbers of the terminal's own colours. They suit dark and light backgrounds."""
MARK_COLOURS: dict[MarkKind, int] = {
    "fault": 9,
    "detection": 3,
    "miss": 5,
    "hold": 11,
    "lost": 1,
    "restart": 2,
    "first difference": 12,
    "trigger": 6,
}
LANE_KINDS: tuple[MarkKind, ...] = ("miss", "hold")
"""Kinds of marks without a vertical line. There may be hundreds, or they last."""
LETTERS = digits + ascii_lowercase
"""Characters that tell curves apart where there are no colours."""
OTHER_MARKER = "·"
PLAIN_HEIGHT = 20
"""Height of a panel with its legend, in lines, if stdout is not a terminal."""
MIN_HEIGHT = 7
"""Smallest height of a panel, in lines."""
VALUE_TICKS = 5
MAX_STATE_NAME = 12


class TerminalSize(NamedTuple):
    """Size of the output: `width` in characters, `height` in lines, and whether it has colours."""

    width: int
    height: int
    has_colours: bool


def measure_terminal(console: Console, margin: int) -> TerminalSize:
    """Return the size of a console, without the lines of a margin at its bottom."""
    has_colours = console.color_system is not None and not console.no_color
    return TerminalSize(console.width, console.height - margin, has_colours)


class Points(NamedTuple):
    """Points of a curve, with its marker and colour, in the form that plotext takes."""

    times: list[float]
    values: list[float]
    marker: str
    colour: int | None


class Scale(NamedTuple):
    """Axis of values: its ends, and places and labels of its ticks."""

    low: float
    high: float
    places: list[float]
    labels: list[str]


def draw_plot(
    panels: Sequence[Panel],
    marks: Sequence[Mark],
    window_s: tuple[float, float],
    size: TerminalSize,
) -> Text:
    """Draw panels, one above the other, with their legends and a list of the marks.

    Args:
        panels: Panels to draw.
        marks: Marks in the window.
        window_s: Beginning and end of the axis of time.
        size: Size of the plot. It is higher if that is not enough for all panels.

    Raises:
        ImportError: plotext is not installed.
    """
    from rich.text import Text

    legends = [_build_legend(panel, size) for panel in panels]
    all_points = [
        # The curves of the other run are below.
        [_list_points(panel, curve, window_s, size) for curve in reversed(panel.curves)]
        for panel in panels
    ]
    scales = [_build_scale(*pair) for pair in zip(panels, all_points, strict=True)]
    # The panels are aligned if all labels are equally long.
    indent = max(len(label) for scale in scales for label in scale.labels)
    groups = [*zip(ascii_uppercase, group_marks(marks), strict=False)]
    listed = [
        _build_text(f"{letter} {group.label}", MARK_COLOURS[group.kind], size)
        for letter, group in groups
    ]
    taken = sum(len(legend) + 1 for legend in legends) + len(groups)
    taken += sum(ceil(len(text) / size.width) for text in listed)
    height = max((size.height - taken) // len(panels), MIN_HEIGHT)
    lines: list[Text] = []
    for panel, points, scale, legend in zip(panels, all_points, scales, legends, strict=True):
        wanted = 2 * len(scale.labels) + 3 if panel.names else height
        box = size._replace(height=min(height, wanted))
        drawn = _draw_panel(points, scale, indent, [group for _, group in groups], window_s, box)
        lines += [Text(panel.label or "value"), drawn, *legend]
    lanes = [_draw_lane(letter, group, indent, window_s, size) for letter, group in groups]
    return Text("\n").join([*lines, *lanes, *listed])


def _draw_panel(
    all_points: Sequence[Points],
    scale: Scale,
    indent: int,
    groups: Sequence[MarkGroup],
    window_s: tuple[float, float],
    size: TerminalSize,
) -> Text:
    """Draw the curves of a panel, and vertical lines at the marks of instants.

    Args:
        all_points: The curves.
        scale: Axis of values.
        indent: Width of the labels of that axis.
        groups: The marks.
        window_s: Beginning and end of the axis of time.
        size: Size of the panel.
    """
    import plotext as plot
    from rich.text import Text

    plot.clear_figure()
    # Use the colours of the terminal.
    plot.theme("clear")
    plot.plotsize(size.width, size.height)
    for group in groups:
        for mark in group.marks:
            if group.kind not in LANE_KINDS and mark.time_s >= window_s[0]:
                plot.vline(mark.time_s, MARK_COLOURS[group.kind] if size.has_colours else None)
    for points in all_points:
        plot.plot(points.times, points.values, marker=points.marker, color=points.colour)
    plot.yticks(scale.places, [label.rjust(indent) for label in scale.labels])
    plot.ylim(scale.low, scale.high)
    plot.xlim(*window_s)
    return Text.from_ansi(plot.build().rstrip("\n"))


def _draw_lane(
    letter: str, group: MarkGroup, indent: int, window_s: tuple[float, float], size: TerminalSize
) -> Text:
    """Draw a line below the panels that has the letter of some marks at their times.

    Args:
        letter: The letter.
        group: The marks.
        indent: Width of the labels of the axis of values.
        window_s: Beginning and end of the axis of time.
        size: Size of the plot.
    """
    columns = size.width - indent - 2
    cells = [" "] * columns
    for mark in group.marks:
        ends = mark.time_s, mark.find_end_s(window_s[1])
        first, last = np.interp(ends, window_s, (0, columns - 1)).round().astype(int).tolist()
        cells[first : last + 1] = letter * (last + 1 - first)
    line = f"{' ' * (indent + 1)}{''.join(cells)}".rstrip()
    return _build_text(line, MARK_COLOURS[group.kind], size)


def _list_points(
    panel: Panel, curve: Curve, window_s: tuple[float, float], size: TerminalSize
) -> Points:
    """Return the points of a curve in a window: its steps, reduced to what the width can show."""
    is_finite = np.isfinite(curve.values)
    times = np.clip(curve.time_s[is_finite], *window_s)
    values = np.asarray(curve.values[is_finite], float)
    # A value holds until the next message.
    times, values = (
        np.append(times, window_s[1:] * bool(len(times))),
        np.append(values, values[-1:]),
    )
    times, values = np.repeat(times, 2)[1:], np.repeat(values, 2)[:-1]
    buckets = 2 * size.width
    if len(times) > 2 * buckets:
        borders = np.linspace(0, len(times), buckets + 1).astype(int)
        picked = sorted(
            {
                int(first + pick(values[first:end]))
                for first, end in pairwise(borders)
                for pick in (np.argmin, np.argmax)
            }
        )
        times, values = times[picked], values[picked]
    colour = CURVE_COLOURS[curve.number % len(CURVE_COLOURS)] if size.has_colours else None
    return Points(times.tolist(), values.tolist(), _choose_marker(panel, curve, size), colour)


def _choose_marker(panel: Panel, curve: Curve, size: TerminalSize) -> str:
    """Return the marker of a curve: braille dots, or a character where there are no colours."""
    if not size.has_colours and len(panel.curves) > 1:
        return LETTERS[panel.curves.index(curve) % len(LETTERS)]
    return OTHER_MARKER if curve.is_other else "braille"


def _build_scale(panel: Panel, all_points: Sequence[Points]) -> Scale:
    """Return the axis of values that fits the points of a panel."""
    values = [value for points in all_points for value in points.values]
    low, high = min(values, default=0.0), max(values, default=0.0)
    if isclose(low, high, rel_tol=1e-9):
        margin = max(abs(low) * 0.01, 0.5)
        low, high = low - margin, high + margin
    if panel.names:
        shown = {float(number): name for name, number in panel.names if low <= number <= high}
        return Scale(low, high, [*shown], [name[:MAX_STATE_NAME] for name in shown.values()])
    places = np.linspace(low, high, VALUE_TICKS).tolist()
    # Enough digits to tell the ticks apart.
    precision = 3 + max(0, ceil(log10(max(abs(low), abs(high)) / (high - low))))
    return Scale(low, high, places, [f"{place:.{precision}g}" for place in places])


def _build_legend(panel: Panel, size: TerminalSize) -> list[Text]:
    """Return the lines that name the curves of a panel. Empty if its label does."""
    from rich.text import Text

    if len(panel.curves) == 1 and panel.curves[0].label in panel.label:
        return []
    lines = [Text()]
    for curve in panel.curves:
        marker = _choose_marker(panel, curve, size).replace("braille", "⠤⠤")
        colour = CURVE_COLOURS[curve.number % len(CURVE_COLOURS)]
        entry = _build_text(f"{marker} {curve.label}  ", colour, size)
        if len(lines[-1]) and len(lines[-1]) + len(entry) > size.width:
            lines.append(Text())
        lines[-1].append_text(entry)
    return lines


def _build_text(text: str, colour: int, size: TerminalSize) -> Text:
    """Return a text in a colour, or without it if there are no colours."""
    from rich.text import Text

    return Text(text, f"color({colour})" if size.has_colours else "")

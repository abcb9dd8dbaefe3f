"""Pictures of benches, as PNG and SVG: a bench says as data what its diagrams show, and this draws.

A diagram has rows (contestants, racks, messages), which all panels of a picture share, or a numeric
axis. Values that span more than `WIDE` are on a logarithmic scale, which is linear below the
smallest of them, so that 0 has its place; unless the diagram is to be linear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from rack.tools.console.pictures import paths_of, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PALETTE = ("#4477aa", "#ee6677", "#ccbb44", "#228833", "#66ccee", "#aa3377")
"""Colours that people with any kind of colour vision can distinguish (after Paul Tol's)."""
BASELINE = "#222222"
PALE = "#bbccdd"
COLUMNS = 4
"""Panels next to each other, at most."""
ROW_IN = 0.34
PANEL_IN = 2.0
WIDE = 15.0
"""Ratio of the largest to the smallest value from which an axis is logarithmic."""
_PAPER = {"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8}
NOTE: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 6.5, "bbox": _PAPER}


class Series(NamedTuple):
    """Points of one kind. `x` are values and `y` numbers of rows, where there are rows.

    `look` is "bar" or "span", both from `starts` (of a bar: 0) to `x`, or matplotlib's format of
    marks and lines. Without a colour it gets the next of the palette.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    look: str = "o"
    colour: str = ""
    starts: Sequence[float] = ()
    notes: Sequence[str] = ()


class Diagram(NamedTuple):
    """Series on one pair of axes, whose labels carry the units."""

    x_label: str
    series: Sequence[Series]
    y_label: str = ""
    title: str = ""
    is_linear: bool = False


def marks(label: str, points: Sequence[tuple[float, float]], look: str = "o") -> Series:
    """Return a series of points, each a value and a row."""
    return Series(label, [value for value, _ in points], [row for _, row in points], look)


def by_row(
    label: str, values: Sequence[float | None], look: str = "o", lower: float = 0.0
) -> Series:
    """Return a series with a value in each row, None: in that row there is none.

    Its marks are `lower` by a part of a row.
    """
    known = [(value, row + lower) for row, value in enumerate(values) if value is not None]
    return marks(label, known, look)


def draw(stem: Path, title: str, panels: Sequence[Diagram], rows: Sequence[str] = ()) -> list[Path]:
    """Write the picture; return its paths, `stem`.png and `stem`.svg."""
    columns = min(COLUMNS, len(panels))
    lines = -(-len(panels) // columns)
    height_in = ROW_IN * len(rows) or PANEL_IN
    paths = paths_of(stem)
    size = 1.6 + 2.8 * columns, 0.9 + lines * (0.9 + height_in)
    with picture(paths, *size, layout="constrained") as figure:
        axes = figure.subplots(lines, columns, squeeze=False, sharey=bool(rows)).flatten()
        for each, panel in zip(axes, panels, strict=False):
            _draw(each, panel, bool(rows))
        for each in axes[len(panels) :]:
            each.set_visible(False)
        if rows:
            axes[0].set_ylim(len(rows) - 0.4, -0.6)
            axes[0].set_yticks(range(len(rows)), rows)
        figure.suptitle(title, fontsize="medium")
    return paths


def _draw(axes: Axes, panel: Diagram, has_rows: bool) -> None:
    for series, colour in zip(panel.series, PALETTE * len(panel.series), strict=False):
        _draw_series(axes, series, series.colour or colour)
    wide = math.inf if panel.is_linear else WIDE
    if has_rows:
        _scale(axes, "x", [x for one in panel.series for x in (*one.x, *one.starts)], wide)
    else:
        _scale(axes, "y", [y for one in panel.series for y in one.y], wide)
        ticks = sorted({x for one in panel.series for x in one.x if x})
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_title(panel.title, fontsize="small", loc="left")
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    which: Literal["x", "both"] = "x" if has_rows else "both"
    axes.grid(axis=which, color=PALE, linewidth=0.4)
    axes.spines[["top", "right"]].set_visible(False)
    if any(one.label and len(one.x) for one in panel.series):
        # Above rows, which it would hide.
        place: dict[str, Any] = {}
        if has_rows:
            place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}
        axes.legend(frameon=False, fontsize=6.5, ncols=1 + has_rows, **place)


def _draw_series(axes: Axes, series: Series, colour: str) -> None:
    look: dict[str, Any] = {"color": colour, "label": series.label or None}
    if series.look == "bar":
        starts = np.asarray(series.starts or np.zeros(len(series.x)))
        axes.barh(series.y, np.asarray(series.x) - starts, 0.6, left=starts, **look)
    elif series.look == "span":
        axes.hlines(series.y, series.starts, series.x, linewidth=3, **look)
    else:
        axes.plot(series.x, series.y, series.look, markersize=5, linewidth=1, **look)
    for x, y, note in zip(series.x, series.y, series.notes, strict=False):
        axes.annotate(note, (x, y), (0, 5), textcoords="offset points", **NOTE)


def _scale(axes: Axes, which: str, values: Sequence[float], wide: float) -> None:
    """Scale the axis of values."""
    from matplotlib.ticker import StrMethodFormatter

    high = max(values, default=0.0)
    low = min((value for value in values if value > 0.0), default=0.0)
    axis = axes.xaxis if which == "x" else axes.yaxis
    set_limits = axes.set_xlim if which == "x" else axes.set_ylim
    if low and high > wide * low:
        set_scale = axes.set_xscale if which == "x" else axes.set_yscale
        set_scale("symlog", linthresh=low)
        begin = 0.0 if min(values) == 0.0 else low / 1.6
        set_limits(begin, 1.6 * high)
    else:
        set_limits(0.0, 1.15 * high or 1.0)
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))

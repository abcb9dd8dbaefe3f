"""The residuals of all levels as a picture. Imports matplotlib: see
`rack.tools.console.pictures`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from rack.levels.timing.level import LevelTiming
from rack.tools.console.pictures import paths_of, picture
from rack.tools.recording.cycles import Cycles
from rack.tools.timing.analysis.analysis import Analysis
from rack.tools.timing.analysis.document import deviation_ns, worst_words

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 9.0
ROW_IN = 0.95
EDGES_IN = 1.6
CYCLES = "#88ccee"
MEASURED = "#222222"
PREDICTED = "#117733"
END = "#cc3311"
"""Colours distinct to the colour-blind too (Paul Tol)."""
BINS = 160
MS = 1e-6


def plot(analysis: Analysis, path: Path) -> None:
    """Draw the part of R_i that the cycles of each level used into `path`.png and `path`.svg."""
    levels = [name for name in analysis.config.board if name in analysis.measured.levels]
    height = ROW_IN * len(levels) + EDGES_IN
    low, high = _span(analysis, levels)
    edges = np.geomspace(low, high, BINS + 1)
    with picture(paths_of(path), WIDTH_IN, height) as figure:
        axes = figure.add_subplot()
        for row, name in enumerate(reversed(levels)):
            level = _Level(
                analysis.cycles[name],
                analysis.measured.levels[name],
                analysis.predicted.levels.get(name),
            )
            _draw(axes, level, row, edges)
        axes.set_yticks(np.arange(len(levels)) + 0.1, levels[::-1])
        axes.set_ylim(-0.35, len(levels) - 0.15)
        _scale(axes, low, high)
        _legend(figure, analysis)
        title = (
            f"{analysis.config.name}: residuals of the cycles, by level"
            f" ({analysis.config.clock.mode})"
        )
        figure.suptitle(title, fontsize=10, y=1 - 0.2 / height)
        figure.subplots_adjust(left=0.15, right=0.73, top=1 - 0.45 / height, bottom=1.05 / height)


def _scale(axes: Axes, low: float, high: float) -> None:
    """Draw the scale, in parts of a cycle, and mark the end of the cycle."""
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    labelled = (1.0,) if high > 300 * low else (1.0, 2.0, 5.0)
    axes.xaxis.set_major_locator(LogLocator(subs=labelled))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda part, _: f"{100 * part:g} %"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.axvline(1.0, color=END, linewidth=1.4)
    axes.text(
        1.03, 0.98, "R_i", transform=axes.get_xaxis_transform(), fontsize=8, color=END, va="top"
    )
    axes.set_xlabel(
        "t_exec + t_comm of a cycle as a part of R_i; from there to the red line is its residual"
    )


def _legend(figure: Figure, analysis: Analysis) -> None:
    """Explain the marks."""
    marks = [
        (
            "v",
            MEASURED,
            (
                f"longest t_exec + longest t_comm, {worst_words(analysis.percentile)}; from there:"
                " alpha"
            ),
        )
    ]
    if analysis.predicted.levels:
        marks.append(("^", PREDICTED, "the same by the budgets"))
    handles: list[Artist] = [Patch(color=CYCLES, label="cycles (number: logarithmic)")]
    handles += [
        Line2D([], [], color=colour, marker=marker, linestyle="", label=words)
        for marker, colour, words in marks
    ]
    figure.legend(handles=handles, loc="lower center", fontsize=8, frameon=False, ncols=3)


def _span(analysis: Analysis, levels: list[str]) -> tuple[float, float]:
    parts = [
        analysis.cycles[name].used_ns / analysis.measured.levels[name].cycle_ns for name in levels
    ]
    least = min(float(each.min()) for each in parts)
    most = max(float(each.max()) for each in parts)
    return max(least, 1e-6) / 1.5, max(most, 1.0) * 1.5


class _Level(NamedTuple):
    """The cycles of a level, and its times: measured, and predicted where it has a budget."""

    cycles: Cycles
    measured: LevelTiming
    predicted: LevelTiming | None


def _draw(axes: Axes, level: _Level, row: int, edges: np.ndarray) -> None:
    """Draw one level: the histogram of its used time, so scaled that a single cycle shows; its
    marks and numbers."""
    cycles, timing, predicted = level
    used_ns = cycles.used_ns[cycles.is_judged]
    counts, _ = np.histogram(used_ns / timing.cycle_ns, edges)
    heights = 0.72 * np.log1p(counts) / np.log1p(max(counts.max(), 1))
    axes.fill_between(edges[:-1], row, row + heights, step="post", color=CYCLES, linewidth=0)
    axes.axhline(row, color="#bbbbbb", linewidth=0.6)
    for side, colour, marker in ((timing, MEASURED, "v"), (predicted, PREDICTED, "^")):
        if side is not None:
            part = (side.execution_ns + side.communication_ns) / side.cycle_ns
            axes.plot([part], [row], marker, color=colour, markersize=6, clip_on=False)
    usual_ms = (timing.cycle_ns - float(np.median(used_ns))) * MS
    words = (
        f"R_i {timing.cycle_ns * MS:g} ms, usually left {usual_ms:.4g} ms\nalpha"
        f" {timing.residual_ns * MS:.4g} ms"
    )
    words += f", deviation {deviation_ns(cycles) * MS:.2g} ms"
    words += "" if predicted is None else f"\nalpha predicted {predicted.residual_ns * MS:.4g} ms"
    axes.annotate(
        words, (1.02, row + 0.1), xycoords=("axes fraction", "data"), fontsize=8, va="center"
    )

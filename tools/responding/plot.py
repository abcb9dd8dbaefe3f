"""The measured responses as a picture: a histogram a level, beside what the model says. matplotlib is loaded here."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rack.tools.responding.response import Answered, Response

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEASURED, GRID, SUM, BOUND = "#0072b2", "#009e73", "#e69f00", "#d55e00"
"""Of the palette of Okabe and Ito, for those who do not see every colour."""
BINS = 20
"""Bars up to the longest response on the grid."""
ROUNDING = 1e-9


def plot(response: Response, folder: Path) -> list[Path]:
    """Write response.png and response.svg into `folder`; return their paths."""
    levels = [level for level in response.courses if any(c.level == level for c in response.measured)]
    figure = Figure(figsize=(8.0, 0.8 + 1.7 * len(levels)), layout="constrained")
    axes = figure.subplots(len(levels), 1, squeeze=False)
    for axis, level in zip(axes[:, 0], levels, strict=True):
        _level(axis, response, level)
    time = "simulated time" if response.lockstep else "the wall clock"
    axes[-1, 0].set_xlabel(f"from giving a command to the torque that rests on it, ms of {time}")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False, fontsize="small")
    paths = [folder / f"response.{kind}" for kind in ("png", "svg")]
    for path in paths:
        figure.savefig(path, dpi=150)
    return paths


def _level(axis: Axes, response: Response, level: str) -> None:
    course, tick_ms = response.courses[level], response.tick_ms
    mine = [command for command in response.measured if command.level == level]
    wait = course.delay + course.cycles[0] - 1
    lines = (
        ((wait + course.sum_eq_3_3) * tick_ms, SUM, "-.", "longest wait to be read + sum, eq. 3.3"),
        (course.longest * tick_ms, GRID, "--", "longest on the grid"),
        ((wait + course.bound_eq_3_2) * tick_ms, BOUND, "-", "longest wait to be read + bound, eq. 3.2"),
    )
    values = [_ms(command, response) for command in mine]
    most = max(lines[2][0], *values)
    # What is just as long as the longest stands before its line, not behind it.
    width = course.longest * tick_ms / BINS
    edges = np.arange(0.0, most + width, width) * (1.0 + ROUNDING)
    axis.hist(values, bins=edges.tolist(), color=MEASURED, label="measured")
    for at, colour, style, label in lines:
        axis.axvline(at, color=colour, linestyle=style, label=label)
    axis.set_xlim(0.0, 1.04 * most)
    axis.set_ylabel("commands")
    axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    axis.set_title(f"{' > '.join(course.levels)}: {len(mine)} commands", fontsize="small", loc="left")
    axis.spines[["top", "right"]].set_visible(False)


def _ms(command: Answered, response: Response) -> float:
    return response.ticks(command) * response.tick_ms if command.wall_ms is None else command.wall_ms

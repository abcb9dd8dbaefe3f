"""The figures of racks as one picture, a row a rack in every panel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rack.tools.console.pictures import paths_of, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rack.tools.lab.benches.systems.figures import SystemFigures
    from rack.tools.lab.benches.systems.motion import PosesRun

BOUND = "#bbccdd"
GRID = "#88aacc"
PEER = "#222222"
DOWN = "#4477aa"
UP = "#ee6677"
OPERATOR = "#ccbb44"
LOWER = 0.14
"""Part of a row between marks of two kinds, and its middle."""
WIDTH_IN = 13.0
ROW_IN = 0.34
FRAME_IN = 1.1
WIDE = 300.0
"""Ratio of the ends of a logarithmic axis from which it shows powers of ten only."""

Value = float | None


class Marks(NamedTuple):
    """The shape and colour of a series of marks, and what it shows."""

    shape: str
    colour: str
    label: str


def plot(figures: Sequence[SystemFigures], folder: Path) -> list[Path]:
    """Write systems.png and systems.svg into `folder`; return their paths."""
    paths = paths_of(folder / "systems")
    with picture(
        paths, WIDTH_IN, 2 * (FRAME_IN + ROW_IN * len(figures)), layout="constrained"
    ) as drawn:
        axes = drawn.subplots(2, 4, sharey=True)
        panels = (_responses, _stops, _plans, _kills, _errors, _bus, _processors, _misses)
        for each, draw in zip(axes.flat, panels, strict=True):
            draw(each, figures)
            each.grid(axis="x", color=BOUND, linewidth=0.4)
            each.spines[["top", "right"]].set_visible(False)
            if each.get_legend_handles_labels()[0]:
                each.legend(
                    loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False, fontsize=7
                )
        axes[0, 0].set_yticks(range(len(figures)), [one.rack for one in figures])
        axes[0, 0].invert_yaxis()
    return paths


def _responses(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    """Draw the bounds of the response as bars, what was measured as marks."""
    rows = range(len(figures))
    ran = [one.realtime for one in figures]
    axes.barh(
        rows, [one.predicted.bound_ms for one in figures], 0.6, color=BOUND, label="bound, eq. 3.2"
    )
    axes.barh(
        rows,
        [one.command_bound_ms or 0.0 for one in ran],
        0.3,
        color=GRID,
        label="on the grid, down",
    )
    down = [None if one.command_ms is None else one.command_ms["max"] for one in ran]
    up = [None if one.status_ms is None else one.status_ms["max"] for one in ran]
    _mark(axes, down, Marks("o", DOWN, "command, longest"), -LOWER)
    _mark(axes, up, Marks("s", UP, "status, longest"), LOWER)
    _logarithmic(axes, "response R_s, ms")


def _stops(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    hold = _of_poses(figures, lambda run: None if run.hold is None else run.hold.rest_ms)
    emergency = _of_poses(figures, lambda run: run.emergency.rest_ms)
    _mark(axes, hold, Marks("D", OPERATOR, "hold at the top"), -LOWER)
    _mark(axes, emergency, Marks("s", UP, "emergency stop"), LOWER)
    _absent(axes, figures)
    _logarithmic(axes, "operator's stop to the arm at rest, ms")


def _plans(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    """Draw a mark for each planner: how long until its plan is visible, and what computing it took
    at most."""
    latency = [
        (row, plan.latency_ms["max"])
        for row, one in enumerate(figures)
        for plan in one.realtime.plans
    ]
    computed = [
        (row, plan.computed_ms["max"])
        for row, one in enumerate(figures)
        for plan in one.realtime.plans
        if plan.computed_ms is not None
    ]
    for found, marks, lower in (
        (latency, Marks("o", DOWN, "until visible, longest"), -LOWER),
        (computed, Marks("x", PEER, "computing, longest"), LOWER),
    ):
        if found:
            rows, values = zip(*found, strict=True)
            axes.plot(
                values,
                [row + lower for row in rows],
                marks.shape,
                color=marks.colour,
                label=marks.label,
                ms=5,
            )
    _logarithmic(axes, "plans, by planner or host, ms")


def _kills(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    """Draw the ticks to detection by a neighbour as a line from the least to the greatest, a mark a
    board."""
    for row, one in enumerate(figures):
        ticks = [kill.neighbour for kill in one.kills.detections if kill.neighbour is not None]
        if ticks:
            axes.hlines(row, min(ticks), max(ticks), color=GRID, linewidth=1)
            axes.plot(
                ticks,
                [row] * len(ticks),
                "o",
                color=DOWN,
                ms=4,
                label="_" if row else "a board killed",
            )
    _logarithmic(axes, "kill to detection by a neighbour, ticks")


def _errors(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    _bars(
        axes,
        _of_poses(figures, lambda run: run.peak_mrad),
        "tracking error of three poses, mrad: peak, rms",
        2,
    )
    _mark(axes, _of_poses(figures, lambda run: run.rms_mrad), Marks("D", PEER, "rms"))
    _absent(axes, figures)


def _bus(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    accesses = [1e-3 * sum(each.accesses for each in one.realtime.bus.values()) for one in figures]
    _bars(axes, accesses, "accesses to the bus, 1000 a second", 1)
    size = [1e-6 * sum(each.bytes for each in one.realtime.bus.values()) for one in figures]
    _mark(axes, size, Marks("D", PEER, "MB a second"))


def _processors(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    _bars(
        axes,
        [sum(one.realtime.loads.values()) for one in figures],
        "processor time of all boards, cores",
        2,
    )
    most = [max(one.realtime.board_loads.values(), default=None) for one in figures]
    _mark(axes, most, Marks("D", PEER, "the busiest board"))


def _misses(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    late = [None if one.realtime.late is None else 100 * one.realtime.late for one in figures]
    _bars(
        axes,
        [100 * one.realtime.missed for one in figures],
        "missed, % of the fastest cycles",
        2,
        late,
    )
    _mark(axes, late, Marks("D", PEER, "cyclictest: late by a cycle"))


def _of_poses(figures: Sequence[SystemFigures], of: Callable[[PosesRun], Value]) -> list[Value]:
    return [None if one.poses is None else of(one.poses) for one in figures]


def _mark(axes: Axes, values: Sequence[Value], marks: Marks, lower: float = 0.0) -> None:
    """Mark a value in each row, `lower` by a part of a row."""
    places = [(value, row + lower) for row, value in enumerate(values) if value is not None]
    if places:
        axes.plot(
            *zip(*places, strict=True),
            marks.shape,
            color=marks.colour,
            markersize=5,
            label=marks.label,
        )


def _absent(axes: Axes, figures: Sequence[SystemFigures]) -> None:
    """Say which racks have no PUMA to move."""
    for row, one in enumerate(figures):
        if one.poses is None:
            place = axes.get_yaxis_transform()
            axes.text(
                0.02,
                row,
                "no PUMA",
                transform=place,
                va="center",
                fontsize=7,
                color=PEER,
                alpha=0.6,
            )


def _bars(
    axes: Axes, values: Sequence[Value], label: str, digits: int, others: Sequence[Value] = ()
) -> None:
    """Draw a bar in each row; `others` have their place on the axis, too."""
    axes.barh(range(len(values)), [value or 0.0 for value in values], 0.6, color=GRID)
    for row, value in enumerate(values):
        if value is not None:
            # In a column: next to a bar it would run into the marks.
            place = axes.get_yaxis_transform()
            axes.text(
                0.99,
                row,
                f"{value:.{digits}f}",
                transform=place,
                ha="right",
                va="center",
                fontsize=7,
            )
    axes.set_xlim(0.0, 1.25 * max((value for value in (*values, *others) if value), default=0.8))
    axes.set_xlabel(label)


def _logarithmic(axes: Axes, label: str) -> None:
    """Make the axis logarithmic, with plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.set_xscale("log")
    low, high = axes.get_xlim()
    if high / low < WIDE:
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(label)

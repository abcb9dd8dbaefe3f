"""The figures of racks as one picture, a row a rack in every panel."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rack.tools.lab.benches.chart import BASELINE, PALE, Diagram, Series, by_row, draw, marks

if TYPE_CHECKING:
    from rack.tools.lab.benches.systems.figures import SystemFigures
    from rack.tools.lab.benches.systems.motion import PosesRun

LOWER = 0.14
"""Part of a row between marks of two kinds, and its middle."""

Figures = Sequence["SystemFigures"]


def plot(figures: Figures, folder: Path) -> list[Path]:
    """Write systems.png and systems.svg into `folder`; return their paths."""
    ran = [one.realtime for one in figures]
    hold = _of_poses(figures, lambda run: None if run.hold is None else run.hold.rest_ms)
    emergency = _of_poses(figures, lambda run: run.emergency.rest_ms)
    late = [None if one.late is None else 100 * one.late for one in ran]
    accesses = [1e-3 * sum(board.accesses for board in one.bus.values()) for one in ran]
    size = [1e-6 * sum(board.bytes for board in one.bus.values()) for one in ran]
    busiest = [max(one.board_loads.values(), default=None) for one in ran]
    panels = {
        "response R_s, ms": _responses(figures),
        "operator's stop to the arm at rest, ms": [
            by_row("hold at the top", hold, "D", -LOWER),
            by_row("emergency stop", emergency, "s", LOWER),
        ],
        "plans, by planner or host, ms": _plans(figures),
        "kill to detection by a neighbour, ticks": _kills(figures),
        "tracking error of three poses, mrad": [
            by_row("peak", _of_poses(figures, lambda run: run.peak_mrad)),
            by_row("rms", _of_poses(figures, lambda run: run.rms_mrad), "D"),
        ],
        "the bus, a second": [
            by_row("1000 accesses", accesses),
            by_row("MB", size, "D"),
        ],
        "processor time, cores": [
            by_row("all boards", [sum(one.loads.values()) for one in ran]),
            by_row("the busiest board", busiest, "D"),
        ],
        "% of the fastest cycles": [
            by_row("missed", [100 * one.missed for one in ran]),
            by_row("cyclictest: late by a cycle", late, "D")._replace(colour=BASELINE),
        ],
    }
    drawn = [Diagram(label, list(series)) for label, series in panels.items()]
    return draw(folder / "systems", "", drawn, [one.rack for one in figures])


def _responses(figures: Figures) -> Iterator[Series]:
    """Yield the bounds of the response as bars, what was measured as marks."""
    ran = [one.realtime for one in figures]
    bounds = by_row("bound, eq. 3.2", [one.predicted.bound_ms for one in figures], "bar")
    yield bounds._replace(colour=PALE)
    yield by_row("on the grid, down", [one.command_bound_ms for one in ran], "|")
    down = [None if one.command_ms is None else one.command_ms["max"] for one in ran]
    up = [None if one.status_ms is None else one.status_ms["max"] for one in ran]
    yield by_row("command, longest", down, "o", -LOWER)
    yield by_row("status, longest", up, "s", LOWER)


def _plans(figures: Figures) -> Iterator[Series]:
    """Yield a mark for each planner: how long until its plan is visible, and computing it took."""
    plans = [(row, plan) for row, one in enumerate(figures) for plan in one.realtime.plans]
    yield marks("until visible, longest", [(plan.latency_ms["max"], row) for row, plan in plans])
    computed = [(plan.computed_ms["max"], row) for row, plan in plans if plan.computed_ms]
    yield marks("computing, longest", computed, "x")


def _kills(figures: Figures) -> Iterator[Series]:
    """Yield the ticks to detection by a neighbour, a mark a board."""
    kills = [
        (kill.neighbour, row)
        for row, one in enumerate(figures)
        for kill in one.kills.detections
        if kill.neighbour is not None
    ]
    yield marks("a board killed", kills)


def _of_poses(figures: Figures, figure: Callable[[PosesRun], float | None]) -> list[float | None]:
    """Return a figure of the motion of each rack; None: it has no PUMA to move."""
    return [None if one.poses is None else figure(one.poses) for one in figures]

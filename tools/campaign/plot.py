"""A campaign as a picture: campaign.png. matplotlib is loaded here alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from tools.campaign.statistics import part_of_bound

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.gridspec import SubplotSpec

Report = dict[str, Any]
SIZE_IN = (13.0, 8.0)
DOT, MEDIAN, BOUND = "#4477aa", "#222222", "#cc3311"
"""Colours that people with any sight tell apart (Paul Tol's)."""
LOWEST = 0.005
"""Least part of a bound that the axis shows: a detection in the same cycle stands there."""


def plot(report: Report, path: Path) -> None:
    """Draw a campaign's document into a PNG file: delays against bounds, curves of size, recovery times."""
    figure = Figure(figsize=SIZE_IN, layout="constrained")
    left, upper, lower = (figure.add_subplot(place) for place in _places(figure))
    _delays(left, report)
    _sizes(upper, report)
    _recoveries(lower, report)
    seconds = f"seed {report['seed']}, {report['summary']['trials']} trials"
    figure.suptitle(f"{report['config']}: faults, {seconds}", fontsize=11)
    figure.savefig(path, dpi=120)


def _places(figure: Figure) -> Iterator[SubplotSpec]:
    """Yield the places of the three drawings: one on the left, two on the right."""
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    yield from (grid[:, 0], grid[0, 1], grid[1, 1])


def _delays(axes: Axes, report: Report) -> None:
    """Each fault's time to detection as a part of its own bound; median, max and bound in numbers beside."""
    kinds = list(report["by_kind"])[::-1]
    for row, kind in enumerate(kinds):
        parts = [_part(f) for f in report["faults"] if f["kind"] == kind and f["seen"] == "detected"]
        known = [max(part, LOWEST) for part in parts if part is not None]
        axes.scatter(known, [row] * len(known), s=22, color=DOT, alpha=0.5, linewidths=0)
        if known:
            axes.scatter([sorted(known)[len(known) // 2]], [row], marker="|", s=180, color=MEDIAN)
        place, frame = (1.01, row), ("axes fraction", "data")
        axes.annotate(_numbers(report["by_kind"][kind]), place, xycoords=frame, fontsize=7, va="center")
    axes.axvline(1.0, color=BOUND, linewidth=1.2)
    axes.set_xscale("log")
    axes.set_xlim(LOWEST * 0.8, max(2.0, axes.get_xlim()[1]))
    axes.set_yticks(range(len(kinds)), kinds, fontsize=8)
    axes.set_xlabel("time to detection, as a part of its bound (red)")
    axes.set_title("found after: median / max of bound, ticks", fontsize=9, loc="right")


def _part(fault: Report) -> float | None:
    """Return a fault's delay as a part of its bound; a bound of the same cycle is kept exactly or not at all."""
    if fault["bound"] == 0 and fault["bound_ms"] is None:
        return LOWEST if fault["delay"] == 0 else 2.0
    return part_of_bound(fault["delay"], fault["bound"], fault["delay_ms"], fault["bound_ms"])


def _numbers(figures: Report) -> str:
    ticks, bound = figures["ticks"], figures["bound_ticks"]
    if ticks is None:
        return f"0 of {figures['injected']} found"
    most = "-" if bound is None else bound["most"]
    return f"{ticks['median']:g} / {ticks['max']:g} of {most}"


def _sizes(axes: Axes, report: Report) -> None:
    for (kind, found), marker in zip(report["sizes"].items(), "os", strict=False):
        seen = [(p["size"], p["delay_ms"]) for p in found["curve"] if p["delay_ms"] is not None]
        unseen = [p["size"] for p in found["curve"] if p["delay_ms"] is None]
        drawn = axes.scatter([s for s, _ in seen], [d for _, d in seen], marker=marker, s=22, alpha=0.7, label=kind)
        colour, edge = drawn.get_facecolor(), axes.get_xaxis_transform()
        # A size that was not found stands at the upper edge.
        axes.scatter(unseen, [1.0] * len(unseen), marker="x", s=24, color=colour, transform=edge, clip_on=False)
        axes.axvline(found["judged_from"], color=colour[0], linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=2.5)
    axes.set_xlabel("size, rad (dotted: must be seen from there; x: not seen)")
    axes.set_ylabel("time to detection, ms")
    if report["sizes"]:
        axes.legend(fontsize=8)
    axes.set_title("size of a sensor's error against the time to its detection", fontsize=9)


def _recoveries(axes: Axes, report: Report) -> None:
    clock_ms = report["clock_ms"]
    rows: dict[str, list[float]] = {}
    for fault in report["faults"]:
        if fault["recovery"] is not None:
            rows.setdefault(fault["kind"], []).append(fault["recovery"] * clock_ms * 1e-3)
    for row, times in enumerate(rows.values()):
        axes.scatter(times, [row] * len(times), s=22, color=DOT, alpha=0.5, linewidths=0)
    axes.set_yticks(range(len(rows)), list(rows), fontsize=8)
    axes.set_xlabel("from the strike until everything is undone, s of simulated time")
    axes.set_title("recovery", fontsize=9)

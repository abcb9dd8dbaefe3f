"""A campaign as a picture, campaign.png. Imports matplotlib: see `rack.tools.console.pictures`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from matplotlib.ticker import NullFormatter

from rack.tools.console.pictures import picture
from rack.tools.faults.campaigns.statistics import part_of_bound

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

Report = dict[str, Any]
SIZE_IN = (13.0, 8.0)
DOT = "#4477aa"
MIDDLE = "#222222"
BOUND = "#cc3311"
"""Colours that people with any kind of colour vision can distinguish (Paul Tol's)."""
WIDEST = 1.5
"""Part of a bound up to which delays are drawn; later ones are arrows at the edge."""


def plot(report: Report, path: Path) -> None:
    """Draw a campaign's document into a PNG file: delays against bounds, curves of size, recovery
    times."""
    trials = f"{report['summary']['trials']} trials, {' and '.join(dict.fromkeys(report['modes']))}"
    with picture([path], *SIZE_IN) as figure:
        for place, draw in zip(_places(figure), (_delays, _sizes, _recoveries), strict=True):
            draw(figure.add_subplot(place), report)
        figure.suptitle(
            f"Faults injected into {report['config']}: {trials}, seed {report['seed']}", fontsize=11
        )


def _places(figure: Figure) -> Iterator[SubplotSpec]:
    """Yield the places of the three drawings: one on the left, two on the right."""
    # Fixed: the numbers next to the left one and the names of kinds need their room whatever is
    # drawn.
    grid = figure.add_gridspec(
        2,
        2,
        width_ratios=(1.15, 1.0),
        left=0.11,
        right=0.98,
        top=0.91,
        bottom=0.08,
        wspace=0.52,
        hspace=0.28,
    )
    yield from (grid[:, 0], grid[0, 1], grid[1, 1])


def _delays(axes: Axes, report: Report) -> None:
    """Draw each fault's time to detection as a part of its own bound; note median and longest in
    cycles."""
    kinds = list(report["by_kind"])[::-1]
    for row, kind in enumerate(kinds):
        found = [f for f in report["faults"] if f["kind"] == kind and f["seen"] == "detected"]
        parts = [part for fault in found if (part := _part(fault)) is not None]
        _row(axes, row, [part for part in parts if part <= WIDEST])
        late = [part for part in parts if part > WIDEST]
        axes.scatter(
            [WIDEST] * len(late), [row] * len(late), marker=">", s=40, color=BOUND, clip_on=False
        )
        if parts:
            axes.scatter([min(WIDEST, median(parts))], [row], marker="|", s=180, color=MIDDLE)
        place = (1.02, row)
        frame = ("axes fraction", "data")
        figures = report["by_kind"][kind]
        cycles = report["by_kind"][kind]["cycles"]
        numbers = f"{figures['detected']} of {figures['injected']}"
        numbers += "" if cycles is None else f"; {cycles['median']:.3g}, {cycles['max']:.3g}"
        axes.annotate(numbers, place, xycoords=frame, fontsize=8, va="center")
    axes.axvline(1.0, color=BOUND, linewidth=1.2)
    axes.set_xlim(-0.03, WIDEST)
    _name_rows(axes, kinds)
    axes.set_xlabel("time to detection as a part of its bound (red); the mark is the median")
    axes.set_title("found of injected; median, longest, cycles", fontsize=9, loc="right")


def _row(axes: Axes, row: int, values: list[float]) -> None:
    axes.scatter(
        values, [row] * len(values), s=26, color=DOT, alpha=0.4, linewidths=0, clip_on=False
    )


def _name_rows(axes: Axes, names: list[str]) -> None:
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_ylim(-0.7, max(0, len(names) - 1) + 0.7)


def _part(fault: Report) -> float | None:
    """Return a fault's delay as a part of its bound; a bound of the same cycle is met exactly or
    not at all."""
    if fault["bound"] == 0 and fault["bound_ms"] is None:
        return 0.0 if fault["delay"] == 0 else 2 * WIDEST
    return part_of_bound(fault["delay"], fault["bound"], fault["delay_ms"], fault["bound_ms"])


def _sizes(axes: Axes, report: Report) -> None:
    """Draw the size of a sensor's error against the time to its detection."""
    edge = axes.get_xaxis_transform()
    clock_ms = report["clock_ms"]
    longest = 10 * clock_ms
    for (kind, found), marker in zip(report["sizes"].items(), "os", strict=False):
        seen = [point for point in found["curve"] if point["delay_ms"] is not None]
        unseen = [point["size"] for point in found["curve"] if point["delay_ms"] is None]
        sizes = [point["size"] for point in seen]
        delays = [point["delay_ms"] for point in seen]
        longest = max([longest, *delays])
        (line,) = axes.plot(sizes, delays, marker, markersize=5, alpha=0.6, label=kind)
        axes.plot(
            unseen, [1.0] * len(unseen), "x", color=line.get_color(), transform=edge, clip_on=False
        )
        axes.axvline(found["judged_from"], color=line.get_color(), linewidth=0.9, linestyle=":")
    if report["sizes"]:
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(NullFormatter())
        # Linear up to a tick: most delays are 0.
        axes.set_yscale("symlog", linthresh=clock_ms)
        axes.set_ylim(-0.5 * clock_ms, 1.5 * longest)
        axes.legend(fontsize=8)
    else:
        axes.text(0.5, 0.5, "no size was tried", ha="center", transform=axes.transAxes)
    axes.set_xlabel("size of the error, rad (dotted: must be found from there; x: not found)")
    axes.set_ylabel("time to detection, ms")


def _recoveries(axes: Axes, report: Report) -> None:
    """Draw the time from each strike until every reaction was undone."""
    times = {
        kind: [f for f in report["faults"] if f["kind"] == kind]
        for kind in reversed(report["by_kind"])
    }
    seconds = {
        kind: [
            fault["recovery"] * report["clock_ms"] * 1e-3
            for fault in faults
            if fault["recovery"] is not None
        ]
        for kind, faults in times.items()
    }
    rows = {kind: found for kind, found in seconds.items() if found}
    for row, found in enumerate(rows.values()):
        _row(axes, row, found)
    _name_rows(axes, list(rows))
    axes.set_xlim(left=0.0)
    axes.set_xlabel("from the strike until every reaction is undone, s of simulated time")

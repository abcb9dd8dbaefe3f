"""A campaign as a chart, campaign.png. Imports matplotlib: see `rack.tools.console.pictures`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from matplotlib.ticker import NullFormatter

from rack.tools.console.pictures import open_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

    from rack.tools.faults.campaigns.report import CampaignReport
    from rack.tools.faults.judge import Judgement

SIZE_IN = (13.0, 8.0)
DOT = "#4477aa"
MIDDLE = "#222222"
BOUND = "#cc3311"
"""Colours that are distinguishable with any kind of colour vision (Paul Tol)."""
MAX_FRACTION = 1.5
"""Fraction of a bound up to which delays are drawn. Longer ones are arrows at the edge."""


def plot_campaign(report: CampaignReport, path: Path) -> None:
    """Draw the charts of a campaign into one image: delays, effects of size, recovery times."""
    order = report.order
    with open_figure([path], *SIZE_IN) as figure:
        for position, draw in zip(
            _list_positions(figure), (_draw_delays, _draw_sizes, _draw_recoveries), strict=True
        ):
            draw(figure.add_subplot(position), report)
        title = f"Faults injected into {order.name}: {report.trials_text}, seed {order.seed}"
        figure.suptitle(title, fontsize=11)


def _list_positions(figure: Figure) -> Iterator[SubplotSpec]:
    """Yield the positions of the three charts: one on the left, two on the right."""
    # Fixed margins: the numbers beside the left chart and the names of kinds always need room.
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


def _draw_delays(axes: Axes, report: CampaignReport) -> None:
    """Draw the detection delay of each fault as a fraction of its bound.

    The median and the maximum of each kind are written beside it, in cycles.
    """
    kinds = list(report.by_kind)[::-1]
    for row, kind in enumerate(kinds):
        detected = [fault for fault in report.list_faults(kind) if fault.seen == "detected"]
        fractions = [
            fraction for fraction in map(_compute_fraction, detected) if fraction is not None
        ]
        _draw_row(axes, row, [fraction for fraction in fractions if fraction <= MAX_FRACTION])
        late_count = sum(fraction > MAX_FRACTION for fraction in fractions)
        axes.scatter(
            [MAX_FRACTION] * late_count,
            [row] * late_count,
            marker=">",
            s=40,
            color=BOUND,
            clip_on=False,
        )
        if fractions:
            axes.scatter(
                [min(MAX_FRACTION, median(fractions))], [row], marker="|", s=180, color=MIDDLE
            )
        figures = report.by_kind[kind]
        numbers = f"{figures.detected} of {figures.injected}"
        if figures.cycles is not None:
            numbers += f"; {figures.cycles.median:.3g}, {figures.cycles.max:.3g}"
        frame = ("axes fraction", "data")
        axes.annotate(numbers, (1.02, row), xycoords=frame, fontsize=8, va="center")
    axes.axvline(1.0, color=BOUND, linewidth=1.2)
    axes.set_xlim(-0.03, MAX_FRACTION)
    _name_rows(axes, kinds)
    axes.set_xlabel("time to detection as a part of its bound (red); the mark is the median")
    axes.set_title("found of injected; median, longest, cycles", fontsize=9, loc="right")


def _draw_row(axes: Axes, row: int, values: list[float]) -> None:
    """Draw values as dots on a horizontal line at height `row`."""
    axes.scatter(
        values, [row] * len(values), s=26, color=DOT, alpha=0.4, linewidths=0, clip_on=False
    )


def _name_rows(axes: Axes, names: list[str]) -> None:
    """Label the rows with names, from the bottom up."""
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_ylim(-0.7, max(0, len(names) - 1) + 0.7)


def _compute_fraction(fault: Judgement) -> float | None:
    """Return the detection delay of a fault as a fraction of its bound. None without a detection.

    For a bound of 0, the result is 0 if the delay is 0, and otherwise too large for the chart.
    """
    if fault.bound == 0 and fault.bound_ms is None:
        return 0.0 if fault.delay == 0 else 2 * MAX_FRACTION
    return fault.fraction_of_bound


def _draw_sizes(axes: Axes, report: CampaignReport) -> None:
    """Draw the detection delay of sensor errors as a function of their size."""
    edge = axes.get_xaxis_transform()
    longest = 10 * report.clock_ms
    for (kind, size_curve), marker in zip(report.curves.items(), "os", strict=False):
        sizes = [point.size for point in size_curve.curve if point.delay_ms is not None]
        delays = [point.delay_ms for point in size_curve.curve if point.delay_ms is not None]
        unseen = [point.size for point in size_curve.curve if point.delay_ms is None]
        longest = max([longest, *delays])
        (line,) = axes.plot(sizes, delays, marker, markersize=5, alpha=0.6, label=kind)
        color = line.get_color()
        axes.plot(unseen, [1.0] * len(unseen), "x", color=color, transform=edge, clip_on=False)
        axes.axvline(size_curve.judged_from, color=color, linewidth=0.9, linestyle=":")
    if report.curves:
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(NullFormatter())
        # Use a linear scale up to one tick, because most delays are 0.
        axes.set_yscale("symlog", linthresh=report.clock_ms)
        axes.set_ylim(-0.5 * report.clock_ms, 1.5 * longest)
        axes.legend(fontsize=8)
    else:
        axes.text(0.5, 0.5, "no size was tried", ha="center", transform=axes.transAxes)
    axes.set_xlabel(
        "size of the error, rad (dotted: smallest that must be detected; x: not detected)"
    )
    axes.set_ylabel("time to detection, ms")


def _draw_recoveries(axes: Axes, report: CampaignReport) -> None:
    """Draw the recovery time of each fault, in a row for each kind."""
    kinds: list[str] = []
    for kind in reversed(report.by_kind):
        ticks = [fault.recovery for fault in report.list_faults(kind) if fault.recovery is not None]
        if ticks:
            _draw_row(axes, len(kinds), [tick * report.clock_ms * 1e-3 for tick in ticks])
            kinds.append(kind)
    _name_rows(axes, kinds)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("from the strike until every reaction is undone, s of simulated time")

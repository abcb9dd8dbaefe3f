"""A campaign as a chart, campaign.png. Imports matplotlib: see `rack.tools.console.pictures`."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from rack.boards.faults.kind import KINDS
from rack.tools.console.pictures import open_figure
from rack.tools.faults.ending import EXTERNAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rack.tools.faults.campaigns.report import CampaignReport
    from rack.tools.faults.judge import Judgement

WIDTH_IN = 11.0
ROW_IN = 0.27
"""Height of a row of the charts."""
DOT = "#4477aa"
BOUND = "#cc3311"
"""Colours that are distinguishable with any kind of colour vision (Paul Tol)."""
MEDIAN: dict[str, Any] = {"marker": "|", "s": 180, "color": "#222222"}
LATE: dict[str, Any] = {"marker": ">", "s": 40, "color": BOUND}
"""Markers of the median and of late detections."""
MAX_FRACTION = 1.5
"""Fraction of a bound up to which delays are drawn. Longer ones are arrows at the edge."""


def plot_campaign(report: CampaignReport, path: Path) -> None:
    """Draw the charts of a campaign into one image: delays and recovery times."""
    height_in = ROW_IN * (len(report.by_kind) + 1) + 1.7
    with open_figure([path], WIDTH_IN, height_in) as figure:
        figure.suptitle(
            f"Faults injected into the rack {report.order.name}: {report.trials_text}", fontsize=13
        )
        delays, recoveries = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
        _draw_delays(delays, report)
        _draw_recoveries(recoveries, report)
        figure.legend(loc="outside lower center", ncols=4)


def _draw_delays(axes: Axes, report: CampaignReport) -> None:
    """Draw the detection delay of each fault as a fraction of its bound.

    The numbers of detected and injected faults of each kind are written beside it.
    """
    kinds = list(report.by_kind)
    for row, kind in enumerate(kinds):
        detected = [fault for fault in report.list_faults(kind) if fault.seen == "detected"]
        fractions = [
            fraction for fraction in map(_compute_fraction, detected) if fraction is not None
        ]
        _draw_row(axes, row, [fraction for fraction in fractions if fraction <= MAX_FRACTION])
        if max(fractions, default=0.0) > MAX_FRACTION:
            axes.scatter(MAX_FRACTION, row, clip_on=False, **LATE)
        if fractions:
            axes.scatter(min(MAX_FRACTION, median(fractions)), row, **MEDIAN)
        figures = report.by_kind[kind]
        numbers = f"{figures.detected} of {figures.injected}"
        frame = ("axes fraction", "data")
        axes.annotate(numbers, (1.02, row), xycoords=frame, va="center")
    axes.annotate("detected", (1.02, -1.0), xycoords=frame)
    axes.scatter([], [], color=DOT, alpha=0.5, label="one fault")
    axes.scatter([], [], label="median of a kind", **MEDIAN)
    axes.scatter([], [], label=f"later than {MAX_FRACTION:g}", **LATE)
    axes.axvline(1.0, color=BOUND, linewidth=1.2, label="longest permitted time")
    axes.set_xlim(-0.03, MAX_FRACTION)
    means = {kind.name: kind.means for kind in KINDS} | {EXTERNAL: "SIGKILL from another process"}
    labels = [f"{kind}: {means[kind]}" for kind in kinds]
    axes.set_yticks(range(len(kinds)), labels)
    axes.set_ylim(len(kinds) - 0.4, -0.6)
    axes.grid(axis="y", alpha=0.25)
    axes.set_title("Time to detection")
    axes.set_xlabel("part of the longest permitted time")


def _draw_row(axes: Axes, row: int, values: list[float]) -> None:
    """Draw values as dots on a horizontal line at height `row`."""
    axes.scatter(
        values, [row] * len(values), s=26, color=DOT, alpha=0.5, linewidths=0, clip_on=False
    )


def _compute_fraction(fault: Judgement) -> float | None:
    """Return the detection delay of a fault as a fraction of its bound. None without a detection.

    For a bound of 0, the result is 0 if the delay is 0, and otherwise too large for the chart.
    """
    if fault.bound == 0 and fault.bound_ms is None:
        return 0.0 if fault.delay == 0 else 2 * MAX_FRACTION
    return fault.fraction_of_bound


def _draw_recoveries(axes: Axes, report: CampaignReport) -> None:
    """Draw the recovery time of each fault, in the rows of the detection delays."""
    for row, kind in enumerate(report.by_kind):
        ticks = [fault.recovery for fault in report.list_faults(kind) if fault.recovery is not None]
        _draw_row(axes, row, [tick * report.clock_ms * 1e-3 for tick in ticks])
    axes.set_xlim(left=0.0)
    axes.grid(axis="y", alpha=0.25)
    axes.set_title("Time to recovery")
    axes.set_xlabel("from the fault to the end of its effects, s")

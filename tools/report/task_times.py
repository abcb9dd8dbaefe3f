"""Times of the cycles of tasks, as data and as the table of `rack report` and `rack analyze`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.boards.timing.trace_times import (
    compute_communication_ns,
    compute_distribution,
    compute_execution_ns,
    compute_gaps_ns,
    compute_lateness_ns,
    compute_response_ns,
)
from rack.tools.console.answer import Document
from rack.tools.console.tables import Blocks, TextTable, format_decimal, format_figure
from rack.tools.report.run_report import RunReport

MS_PER_NS = 1e-6
CLOCK_COLUMNS = {
    "late p50": ("lateness_ms", "p50"),
    "late p99": ("lateness_ms", "p99"),
    "late max": ("lateness_ms", "max"),
    "residual min": ("residual_ms", "min"),
    "deviation": ("deviation_ms", ""),
    "alpha": ("alpha_ms", ""),
}
"""Columns of times relative to a release or a time slice, which have no meaning in lockstep.

The values are the key in the entry of a task, and the statistic of the distribution.
"""
USED_COLUMNS = {
    "exec p50": ("execution_ms", "p50"),
    "exec p99": ("execution_ms", "p99"),
    "exec max": ("execution_ms", "max"),
    "comm p99": ("communication_ms", "p99"),
    "proc p99": ("processor_ms", "p99"),
    "plan age max": ("plan_age_ms", "max"),
}
DROPPED_COLUMNS = (
    "deviation",
    "comm p99",
    "proc p99",
    "late p50",
    "exec p50",
    "alpha",
    "late p99",
    "exec p99",
    "plan age max",
    "R",
    "cycles",
)
"""Columns that are left out on a narrow terminal, in the order in which they are dropped."""


def compute_task_times(
    task: TaskSpec,
    cycles: np.ndarray,
    period_ns: int,
    takes_time: bool,
    *,
    stretches: np.ndarray,
    due_ns: int,
    parts_ns: tuple[np.ndarray, np.ndarray] | None = None,
) -> Document:
    """Return the times in ms of a task's cycles, as in eq. 3.5: R = t_exec + t_comm + t_residual.

    `processor_ms` is the processor time of a cycle and of waking up for it, without waiting and
    preemption. For a planner, each plan is a cycle, and R is the time slice. In lockstep a tick
    lasts as long as its tasks take, so everything relative to a release or a time slice is None.

    Args:
        task: The task.
        cycles: Trace records of the task, shape (n,).
        period_ns: Length of a tick on the wall clock.
        takes_time: Whether computing took time: in real time, or on simulated cores.
        stretches: Number of the recorded stretch of each cycle, shape (n,). Gaps are measured only
            between cycles of the same stretch.
        due_ns: Time from a release to the deadline.
        parts_ns: t_exec and t_comm of each cycle. Defaults to the traced times on the wall clock.
    """
    slice_ns = task.slice * period_ns
    gaps = compute_gaps_ns(cycles, stretches)
    execution, communication = parts_ns or (
        compute_execution_ns(cycles),
        compute_communication_ns(cycles),
    )
    by_the_clock: Document = {
        "lateness_ms": compute_distribution(compute_lateness_ns(cycles) * MS_PER_NS),
        # The time from the end of a cycle to its deadline, negative if the deadline was missed.
        "residual_ms": compute_distribution((due_ns - compute_response_ns(cycles)) * MS_PER_NS),
        "largest_gap_ms": round(float(gaps.max()) * MS_PER_NS, 6) if len(gaps) else None,
        "alpha_ms": None,
        "deviation_ms": None,
    }
    if len(cycles):
        # Eq. 3.6: alpha is the residual time that is guaranteed in the worst case. The longest
        # execution and the longest communication may come from different cycles. The deviation
        # is reported because smooth motion needs a small one.
        alpha_ns = slice_ns - int(execution.max()) - int(communication.max())
        by_the_clock["alpha_ms"] = round(alpha_ns * MS_PER_NS, 6)
        by_the_clock["deviation_ms"] = round(
            float((execution + communication).std()) * MS_PER_NS, 6
        )
    return {
        "traced": len(cycles),
        "slice_ms": slice_ns * MS_PER_NS,
        "execution_ms": compute_distribution(execution * MS_PER_NS),
        "communication_ms": compute_distribution(communication * MS_PER_NS),
        "processor_ms": compute_distribution(cycles["processor_ns"] * MS_PER_NS),
        **(by_the_clock if takes_time else dict.fromkeys(by_the_clock)),
    }


def build_times_table(tasks: Mapping[str, Document], takes_time: bool) -> TextTable:
    """Return a table with one line per task, and only the columns that apply in lockstep."""
    columns = CLOCK_COLUMNS | USED_COLUMNS if takes_time else USED_COLUMNS
    rows = [
        {
            "task": name,
            "R": task["slice_ms"],
            **{key: task.get(key) for key in ("cycles", "missed", "skipped")},
            **{
                column: format_figure(task.get(key), quantile)
                if quantile
                else format_decimal(task[key])
                for column, (key, quantile) in columns.items()
            },
        }
        for name, task in tasks.items()
    ]
    return TextTable(rows, DROPPED_COLUMNS)


def format_times(report: RunReport) -> Blocks:
    """Yield the section of a report with the table of cycle times."""
    yield from ("", "## Cycles, ms", "")
    if not report.takes_time:
        yield (
            "In lockstep a tick lasts as long as its tasks take, so there are no deadlines, no"
            " lateness and no residuals, except in cycles that take simulated time."
        )
        yield ""
    for name, (traced, ran) in report.untraced.items():
        yield from (f"Times of {name} are from {traced:,} of {ran:,} cycles.", "")
    yield build_times_table(report.tasks, report.takes_time)

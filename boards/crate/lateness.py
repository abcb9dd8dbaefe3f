"""Check whether the tasks of a run kept up with the clock.

Every release without a finished cycle counts as a skipped cycle, whatever the reason: the task was
late, or its board was dead, restarting, or not back before the end of the run.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from rack.backplane.fault_table import FaultTable, Stage
from rack.backplane.layout import TaskSpec
from rack.backplane.segment import Segment
from rack.boards.config.schema import RackConfig
from rack.boards.faults.describe import describe_fault, find_board
from rack.boards.faults.kind import find_kind


def find_late_tasks(segment: Segment, config: RackConfig, end: int) -> tuple[list[str], list[str]]:
    """Find the tasks that missed or skipped more cycles than the config permits.

    Tasks only count their lost cycles, and do not record which of them an injected fault caused.
    Every task may therefore lose as many cycles as were due between the first effect of a fault and
    the latest end of recovery that the fault's kind permits. Any further lost cycles must not
    exceed `max_missed_fraction` of the cycles that were due at other times.

    Args:
        segment: Segment of the rack. Its boards must have finished their last cycles.
        config: Config of the rack.
        end: Length of the run in ticks.

    Returns:
        A line for each task that lost too many cycles, and a line for each task that would have
        lost too many if cycles during faults and recoveries counted as well.
    """
    late = []
    excused = []
    layout = segment.layout
    fraction = config.supervision.max_missed_fraction
    restart_s = config.supervision.find_restart_time(config.clock.mode == "lockstep")
    table = FaultTable(segment).list_entries((Stage.ACTIVE, Stage.OVER))
    faults = [fault for fault in table if fault.struck_tick >= 0]
    for task in layout.tasks:
        counts = segment.count_cycles(task, end)
        disturbed = []
        for fault in faults:
            kind = find_kind(fault)
            recovery = kind.compute_recovery_ticks(find_board(fault, layout), layout, restart_s)
            recovery += kind.compute_tail_ticks(fault, layout)
            # The cycle in progress at the first effect of the fault may also be lost.
            first = max(0, fault.struck_tick - task.slice + 1)
            disturbed.append((first, min(end, fault.until + recovery)))
        excusable = min(counts.due, _count_releases(task, disturbed))
        rest = counts.lost - excusable
        judged = counts.due - excusable
        text = f"level '{task.name}' {counts}"
        if excusable:
            named = ", ".join(describe_fault(fault, layout, config.joints) for fault in faults)
            text += f", {excusable} of which were due during faults and recoveries: {named}"
        if rest > _count_permitted(judged, fraction, counts.plan):
            share = f"{100 * rest / judged:.3g} %; at most {100 * fraction:.3g} % permitted"
            late.append(f"{text} ({share})")
        elif counts.lost > _count_permitted(counts.due, fraction, counts.plan):
            excused.append(text)
    return late, excused


def _count_releases(task: TaskSpec, spans: Iterable[tuple[int, int]]) -> int:
    """Return the number of releases of a task in the union of spans of ticks [first, end)."""
    count = 0
    reached = 0
    for first, end in sorted(spans):
        first = max(first, reached)
        if first < end:
            reached = end
            count += (task.grid.find_tick(end) - task.grid.find_tick(first)) // task.every
    return count


def _count_permitted(due: int, fraction: float, plan: int) -> int:
    """Return how many of the due cycles may be lost.

    The number is rounded up to whole plans, so that one late cycle or plan does not fail a short
    run. It is always less than `due`, unless the fraction is 1.

    Args:
        due: Number of cycles that were due.
        fraction: Fraction of them that may be lost.
        plan: Number of cycles that count as lost for one late plan.
    """
    permitted = plan * math.ceil(fraction * due / plan)
    return permitted if fraction == 1 else max(0, min(permitted, due - 1))

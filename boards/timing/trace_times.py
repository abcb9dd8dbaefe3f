"""Measured times of the timing model, computed from trace records.

Report, analysis, charts, viewer, snapshots and benchmarks all use these functions. Times are in ns
of the wall clock unless a function states otherwise.

A trace measures unit functions in two ways: their borders have wall-clock time stamps, and the
processor time is counted for the whole cycle. If a cycle was preempted, the two differ, and
`compute_unit_times` reconciles them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.trace import SKIPPED_SHIFT, Flag

STAMPS = ("start_ns", "plan_ns", "read_ns", "process_ns", "end_ns")
"""Time stamps of a record, in order."""
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99_9": 99.9}
UNDISTURBED = 10.0
"""Percentile that is taken as the undisturbed time of a part.

The median would be too large on a host that suspends the machine during nearly every plan.
"""
TraceRows = np.ndarray
"""Trace records of one task, oldest first, (n,), of dtype `rack.backplane.trace.RECORD`."""
Values = np.ndarray
"""One value per record, (n,), unless a function states otherwise."""
Distribution = dict[str, float]


def compute_lateness_ns(rows: TraceRows) -> Values:
    """Return the time in ns from the release of each cycle to its start."""
    return np.asarray(rows["start_ns"] - rows["release_ns"])


def compute_response_ns(rows: TraceRows) -> Values:
    """Return the time in ns from the release of each cycle to its end."""
    return np.asarray(rows["end_ns"] - rows["release_ns"])


def compute_duration_ns(rows: TraceRows) -> Values:
    """Return the time in ns from the start of each cycle to its end, including preemption."""
    return np.asarray(rows["end_ns"] - rows["start_ns"])


def compute_execution_ns(rows: TraceRows) -> Values:
    """Return t_exec of eq. 3.5, or a planner's planning time, in ns, including preemption."""
    return np.asarray(rows["process_ns"] - rows["read_ns"])


def compute_communication_ns(rows: TraceRows) -> Values:
    """Return t_comm of eq. 3.5: the duration of each cycle minus its execution, in ns."""
    return np.asarray(compute_duration_ns(rows) - compute_execution_ns(rows))


def compute_gaps_ns(rows: TraceRows, stretches: Values | None = None) -> Values:
    """Return the times in ns between the starts of consecutive cycles.

    Args:
        rows: Trace records.
        stretches: For each record, the number of the uninterrupted part of the recording that
            contains it, shape (n,). Times from one part to the next are left out. None if the
            recording is uninterrupted.
    """
    gaps = np.diff(rows["start_ns"])
    return gaps if stretches is None else gaps[np.diff(stretches) == 0]


def find_missed_cycles(rows: TraceRows) -> Values:
    """Return for each cycle whether it missed its deadline or wrote a message too late."""
    return np.asarray((rows["flags"] & Flag.MISSED) > 0)


def count_skipped_releases(rows: TraceRows) -> Values:
    """Return for each cycle the number of releases skipped between it and the previous cycle."""
    return np.asarray(rows["flags"] >> SKIPPED_SHIFT)


def count_misses_and_skips(rows: TraceRows) -> tuple[int, int]:
    """Return the number of missed cycles and the number of skipped releases."""
    return int(np.count_nonzero(find_missed_cycles(rows))), int(count_skipped_releases(rows).sum())


def select_plans(rows: TraceRows) -> Values:
    """Return the records of cycles in which a planner made a plan.

    The other records are of cycles in which the planner decided not to plan.
    """
    return rows[(rows["flags"] & Flag.PLANNED) > 0]


def find_newest_visible(ticks: Values, visible_at: Values) -> Values:
    """Return the index of the newest message visible at each tick. -1 if none is visible.

    Args:
        ticks: The ticks.
        visible_at: Ticks at which messages become visible, in the order in which they were written.
    """
    # Messages become visible in the order of writing, so a late one delays those after it.
    return np.asarray(np.searchsorted(np.maximum.accumulate(visible_at), ticks, side="right") - 1)


def compute_plan_ages(executor: Values, made: Values, visible_at: Values) -> Values:
    """Return the age in ticks of the newest plan that each cycle of an executor could read.

    Cycles before the first visible plan are left out.

    Args:
        executor: Ticks of the executor's cycles, in order.
        made: Ticks at which the plans were requested, in order.
        visible_at: Ticks at which the plans became visible, in order.
    """
    newest = find_newest_visible(executor, visible_at)
    seen = newest >= 0
    return np.asarray(executor[seen] - made[newest[seen]])


def compute_distribution(values: Values) -> Distribution | None:
    """Return minimum, percentiles and maximum of values of any unit, shape (n,).

    Returns:
        The statistics, keyed by name: min, p50, p99, p99_9 and max. None if there are no values.
    """
    if not len(values):
        return None
    percentiles = {name: np.percentile(values, percent) for name, percent in PERCENTILES.items()}
    statistics = {"min": values.min(), **percentiles, "max": values.max()}
    return {name: round(float(value), 6) for name, value in statistics.items()}


class Occupation:
    """Union of time intervals in which a core was occupied.

    Attributes:
        starts: Starts of the disjoint intervals in ns, shape (n,).
        ends: Their ends in ns, shape (n,).
    """

    def __init__(self, starts: Values, ends: Values) -> None:
        """Form the union of intervals from `starts` to `ends`, in ns, shape (m,), in any order."""
        order = np.argsort(starts, kind="stable")
        starts, ends = starts[order], np.maximum.accumulate(np.maximum(starts, ends)[order])
        # An interval that begins after the end of all earlier ones starts a new interval of the
        # union.
        first = np.ones(len(starts), bool)
        first[1:] = starts[1:] > ends[:-1]
        self.starts = starts[first]
        self.ends = ends[np.roll(first, -1)]
        self._sums = np.cumsum(self.ends - self.starts)

    @classmethod
    def from_records(cls, rows: TraceRows) -> Occupation:
        """Return the times in which a task occupied its core, including wake-up and overhead."""
        half = compute_overhead_ns(rows) // 2
        return cls(rows["start_ns"] - half, rows["end_ns"] + half)

    @classmethod
    def merge(cls, many: Sequence[Occupation]) -> Occupation:
        """Return the union of several occupations."""
        empty = np.empty(0, np.int64)
        return cls(
            np.concatenate([empty, *(occupation.starts for occupation in many)]),
            np.concatenate([empty, *(occupation.ends for occupation in many)]),
        )

    def compute_overlap(self, starts: Values, ends: Values) -> Values:
        """Return the occupied time in ns within each interval from `starts` to `ends`."""
        return np.asarray(
            self._compute_occupied_before(ends) - self._compute_occupied_before(starts)
        )

    def _compute_occupied_before(self, times: Values) -> Values:
        """Return the occupied time in ns before each of `times`."""
        begun = np.searchsorted(self.starts, times, side="right")
        if not len(self.starts):
            return np.zeros(np.shape(times), np.int64)
        newest = np.maximum(begun - 1, 0)
        beyond = np.clip(self.ends[newest] - times, 0, None)
        return np.asarray(np.where(begun > 0, self._sums[newest] - beyond, 0))


def compute_overhead_ns(rows: TraceRows) -> int:
    """Return the median processor time in ns for waking up and for closing a cycle.

    It is 0 if every cycle was preempted.
    """
    # The processor time before the start and after the end, which is negative after a preemption.
    beyond = rows["processor_ns"] - compute_duration_ns(rows)
    undisturbed = beyond[beyond >= 0]
    return int(np.median(undisturbed)) if len(undisturbed) else 0


def compute_unit_times(rows: TraceRows, above: Occupation) -> Values:
    """Return the processor time in ns of each part of a cycle, shape (n, 4).

    The parts of an executor are C, R, X and W. Those of a planner are an unused part, reading, P
    without reading, and U.

    If ordinary scheduling or the machine has interfered, the parts add up to more than the
    processor time of the cycle. The excess is subtracted first from parts that took longer than
    undisturbed ones, then from all parts in proportion to their times.

    Args:
        rows: Trace records of the task.
        above: Times in which tasks of higher priority occupied the core. They are subtracted from
            the parts that they interrupted.
    """
    stamps = np.stack([rows[name] for name in STAMPS], axis=1)
    starts = stamps[:, :-1]
    ends = stamps[:, 1:]
    parts = ends - starts - above.compute_overlap(starts, ends)
    beyond = parts.sum(axis=1) - rows["processor_ns"]
    beyond = np.where(beyond > 0, beyond + compute_overhead_ns(rows), 0)
    unusual = np.clip(parts - _estimate_undisturbed(parts, rows["processor_ns"]), 0, None)
    parts = parts - _distribute(beyond, unusual)
    rest = np.clip(parts.sum(axis=1) - rows["processor_ns"], 0, None)
    return np.asarray(np.rint(parts - _distribute(rest, parts)), np.int64)


def _estimate_undisturbed(parts: Values, processor_ns: Values) -> Values:
    """Estimate the time in ns that each part takes if nothing disturbs it, shape (4,).

    Short parts are undisturbed in many cycles. The longest part may be disturbed in all of them, so
    its time is limited to the processor time that the other parts leave.
    """
    usual = np.asarray(np.percentile(parts, UNDISTURBED, axis=0))
    longest = int(np.argmax(usual))
    left = np.percentile(processor_ns, UNDISTURBED) - (usual.sum() - usual[longest])
    if 0 < left < usual[longest]:
        usual[longest] = left
    return usual


def _distribute(total: Values, weights: Values) -> Values:
    """Distribute `total`, shape (n,), in proportion to `weights`, shape (n, 4).

    A share never exceeds its weight, even if the shares then do not add up to the total.
    """
    sums = weights.sum(axis=1)
    factor = np.divide(np.minimum(total, sums), sums, out=np.zeros(len(sums)), where=sums > 0)
    return np.asarray(weights * factor[:, None])

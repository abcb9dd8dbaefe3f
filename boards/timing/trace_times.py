"""Times from a trace: the measured side of the timing model.

Report, analysis, charts, viewer, snapshots and benchmarks all derive their times here. Times are ns
of the wall clock, unless a function says otherwise.

A trace measures a unit function in two ways. Its borders are stamped by the wall clock; processor
time is counted for the cycle as a whole. Where a cycle was preempted the two differ, and
`unit_times` reconciles them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.boards.timing.tasks import Unit

STAMPS = ("start_ns", "plan_ns", "read_ns", "process_ns", "end_ns")
"""The time stamps of a record, in order."""
UNITS = {
    "executor": (
        (Unit.EXCHANGE, "start_ns", "plan_ns"),
        (Unit.READ, "plan_ns", "read_ns"),
        (Unit.PROCESS, "read_ns", "process_ns"),
        (Unit.WRITE, "process_ns", "end_ns"),
    ),
    "planner": ((Unit.PLAN, "start_ns", "process_ns"), (Unit.UPDATE, "process_ns", "end_ns")),
}
"""The unit functions of a record, by role, with their first and last time stamp. A planner's
reading is part of P."""
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99_9": 99.9}
UNDISTURBED = 10.0
"""Percentile of a part's times taken for its undisturbed time: on a host that takes the machine
away in nearly every plan, their median is not."""
Rows = np.ndarray
"""Trace records of one task, oldest first, (n,), of dtype `rack.backplane.trace.RECORD`."""
Values = np.ndarray
"""One value per record, (n,), unless a function says otherwise."""
Distribution = dict[str, float]


def lateness_ns(rows: Rows) -> Values:
    """Return the time from release to start."""
    return np.asarray(rows["start_ns"] - rows["release_ns"])


def response_ns(rows: Rows) -> Values:
    """Return the time from release to end."""
    return np.asarray(rows["end_ns"] - rows["release_ns"])


def lasted_ns(rows: Rows) -> Values:
    """Return the time from start to end, preemption included."""
    return np.asarray(rows["end_ns"] - rows["start_ns"])


def execution_ns(rows: Rows) -> Values:
    """Return t_exec of eq. 3.5 (of a planner: its planning), preemption included."""
    return np.asarray(rows["process_ns"] - rows["read_ns"])


def communication_ns(rows: Rows) -> Values:
    """Return t_comm of eq. 3.5: everything between start and end that is not execution."""
    return np.asarray(rows["read_ns"] - rows["start_ns"] + rows["end_ns"] - rows["process_ns"])


def residual_ns(rows: Rows, slice_ns: int) -> Values:
    """Return t_residual: the part of a time slice left when the cycle ended; negative after a
    miss.
    """
    return np.asarray(rows["release_ns"] + slice_ns - rows["end_ns"])


def gaps_ns(rows: Rows, stretches: Values | None = None) -> Values:
    """Return the time from each start to the next one, shape (n - 1,); less with the number of the
    recording's stretch for each row: what was between two stretches is unknown.
    """
    gaps = np.diff(rows["start_ns"])
    return gaps if stretches is None else gaps[np.diff(stretches) == 0]


def is_missed(rows: Rows) -> Values:
    """Return which cycles missed their deadline, or wrote a message too late; bool."""
    return np.asarray((rows["flags"] & Flag.MISSED) > 0)


def skipped(rows: Rows) -> Values:
    """Return the number of releases skipped just before each cycle."""
    return np.asarray(rows["flags"] >> SKIPPED_SHIFT)


def counts(rows: Rows) -> tuple[int, int]:
    """Return the number of cycles missed and of releases skipped."""
    return int(np.count_nonzero(is_missed(rows))), int(skipped(rows).sum())


def plans(rows: Rows) -> Values:
    """Return the records of a planner that made a plan: a release that passed without one may leave
    a record too.
    """
    return rows[(rows["flags"] & Flag.PLANNED) > 0]


def newest_visible(ticks: Values, visible_at: Values) -> Values:
    """Return the index of the newest message visible at each tick, -1 before the first.

    `visible_at` holds the ticks from which messages are visible, in the order of their writing.
    """
    # A message that becomes visible late delays those after it.
    return np.asarray(np.searchsorted(np.maximum.accumulate(visible_at), ticks, side="right") - 1)


def plan_ages(executor: Values, made: Values, visible_at: Values) -> Values:
    """Return the age in ticks of the plan that each cycle of an executor could read, without cycles
    before the first.

    `executor` holds the ticks of its cycles, `made` and `visible_at` those of the plans, in order.
    """
    newest = newest_visible(executor, visible_at)
    seen = newest >= 0
    return np.asarray(executor[seen] - made[newest[seen]])


def distribution(values: Values) -> Distribution | None:
    """Return min, p50, p99, p99.9 and max of values of any unit, shape (n,); None when there are
    none.
    """
    if not len(values):
        return None
    found = {"min": float(values.min())}
    found |= {name: float(np.percentile(values, percent)) for name, percent in PERCENTILES.items()}
    return {name: round(value, 6) for name, value in (found | {"max": float(values.max())}).items()}


class Occupation:
    """When a core was occupied: a union of intervals. `starts` and `ends` are those of the union,
    ns, shape (n,).
    """

    def __init__(self, starts: Values, ends: Values) -> None:
        """Take intervals from `starts` to `ends`, each of shape (n,), in any order."""
        order = np.argsort(starts, kind="stable")
        starts, ends = starts[order], np.maximum.accumulate(np.maximum(starts, ends)[order])
        # An interval that begins after the end of all before it begins a new block.
        first = np.ones(len(starts), bool)
        first[1:] = starts[1:] > ends[:-1]
        self.starts = starts[first]
        self.ends = ends[np.roll(first, -1)]
        self._sums = np.cumsum(self.ends - self.starts)

    @classmethod
    def of(cls, rows: Rows) -> Occupation:
        """Return when a task needed its core: from waking up to closing the cycle."""
        half = overhead_ns(rows) // 2
        return cls(rows["start_ns"] - half, rows["end_ns"] + half)

    @classmethod
    def union(cls, many: Sequence[Occupation]) -> Occupation:
        """Return the union of several."""
        none = np.empty(0, np.int64)
        return cls(
            np.concatenate([none, *(each.starts for each in many)]),
            np.concatenate([none, *(each.ends for each in many)]),
        )

    def within(self, starts: Values, ends: Values) -> Values:
        """Return the occupied time in each interval from `starts` to `ends`, shape as given."""
        return np.asarray(self._until(ends) - self._until(starts))

    def _until(self, times: Values) -> Values:
        """Return the occupied time before each of `times`."""
        begun = np.searchsorted(self.starts, times, side="right")
        if not len(self.starts):
            return np.zeros(np.shape(times), np.int64)
        newest = np.maximum(begun - 1, 0)
        beyond = np.clip(self.ends[newest] - times, 0, None)
        return np.asarray(np.where(begun > 0, self._sums[newest] - beyond, 0))


def waking_ns(rows: Rows) -> Values:
    """Return the processor time used between release and start, to wake up."""
    return np.asarray(np.clip(_beyond_stamps(rows), 0, np.maximum(lateness_ns(rows), 0)))


def overhead_ns(rows: Rows) -> int:
    """Return the median processor time of waking up for a cycle and closing it; 0 where every cycle
    was disturbed.
    """
    beyond = _beyond_stamps(rows)
    undisturbed = beyond[beyond >= 0]
    return int(np.median(undisturbed)) if len(undisturbed) else 0


def _beyond_stamps(rows: Rows) -> Values:
    """Return processor time less the time from start to end: negative where others had the core
    meanwhile.
    """
    return np.asarray(rows["processor_ns"] - lasted_ns(rows))


def unit_times(rows: Rows, above: Occupation) -> Values:
    """Return the processor time of each part of a cycle, shape (n, 4): C, R, X, W; of a planner 0,
    reading, P, U.

    `above` is when tasks of higher priority had the core: that is taken off the part in which they
    ran. Where the sum still exceeds the processor time, because ordinary scheduling or the machine
    interfered, the rest is taken off what parts take beyond their undisturbed time, then off all in
    proportion.
    """
    stamps = np.stack([rows[name] for name in STAMPS], axis=1)
    starts = stamps[:, :-1]
    ends = stamps[:, 1:]
    parts = ends - starts - above.within(starts, ends)
    beyond = parts.sum(axis=1) - rows["processor_ns"]
    beyond = np.where(beyond > 0, beyond + overhead_ns(rows), 0)
    unusual = np.clip(parts - _undisturbed(parts, rows["processor_ns"]), 0, None)
    parts = parts - _shared_out(beyond, unusual)
    rest = np.clip(parts.sum(axis=1) - rows["processor_ns"], 0, None)
    return np.asarray(np.rint(parts - _shared_out(rest, parts)), np.int64)


def _undisturbed(parts: Values, processor_ns: Values) -> Values:
    """Return the undisturbed time of each part, shape (4,).

    A short part is undisturbed in many cycles. The longest may be disturbed in all of them: of it,
    that is what the others leave of the processor time.
    """
    usual = np.asarray(np.percentile(parts, UNDISTURBED, axis=0))
    longest = int(np.argmax(usual))
    left = np.percentile(processor_ns, UNDISTURBED) - (usual.sum() - usual[longest])
    if 0 < left < usual[longest]:
        usual[longest] = left
    return usual


def _shared_out(total: Values, weights: Values) -> Values:
    """Return `total`, shape (n,), distributed by `weights`, shape (n, 4), none more than its
    weight.
    """
    sums = weights.sum(axis=1)
    factor = np.divide(np.minimum(total, sums), sums, out=np.zeros(len(sums)), where=sums > 0)
    return np.asarray(weights * factor[:, None])

"""The Gantt chart of a run, from its trace.

Spans of unit functions are cut where a task of higher priority had the core.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rack.boards.config import RackConfig, build_rack_timing
from rack.boards.timing.schedule import Chart, Job, Span
from rack.boards.timing.tasks import Budget, TimedTask, Unit
from rack.boards.timing.trace_times import (
    compute_duration_ns,
    compute_lateness_ns,
    compute_response_ns,
    count_skipped_releases,
    select_plans,
)
from rack.tools.recording.recording import Recording
from rack.tools.timing.charts.panel import JobCount, Panel, merge_stretches, subtract_stretches
from rack.tools.timing.charts.patterns import (
    Lane,
    PatternDetail,
    Patterns,
    Stretch,
    build_lanes,
    count_patterns,
)

UNITS = {
    "executor": (
        (Unit.EXCHANGE, "start_ns", "plan_ns"),
        (Unit.READ, "plan_ns", "read_ns"),
        (Unit.PROCESS, "read_ns", "process_ns"),
        (Unit.WRITE, "process_ns", "end_ns"),
    ),
    "planner": ((Unit.PLAN, "start_ns", "process_ns"), (Unit.UPDATE, "process_ns", "end_ns")),
}
"""Unit functions of a record, by role, with their first and last time stamps.

The reading of a planner is part of P.
"""
BLOCK_NS = 1_000_000_000
"""Length of the part of a run that is read at once, ns, which limits the required memory."""


class TracedRun:
    """A recorded run in terms of the timing model. Times are in ns of the wall clock since tick 0.

    Raises:
        ConfigError: If a file named by the config of the run is missing.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.config: RackConfig = recording.rack_config
        layout = recording.layout
        known = build_rack_timing(
            self.config, layout, dict.fromkeys(self.config.board, Budget())
        ).tasks
        # Use the cores that the run obtained. The clock leaves no trace.
        self.tasks = tuple(
            replace(t, core=layout.find_task(t.name).core) for t in known if t.role != "clock"
        )

    def build_panel(self, start_ns: int, end_ns: int, progress: Callable[[float], None]) -> Panel:
        """Build the panel of a window.

        Args:
            start_ns: Start of the window, ns.
            end_ns: End of the window, ns.
            progress: Receives the fraction of the run that has been read.
        """
        lanes = build_lanes(self.tasks)
        details = {
            lane.name: PatternDetail.from_medians(lane, self._compute_medians(lane))
            for lane in lanes
        }
        counted = {lane.name: Patterns(Counter(), Counter()) for lane in lanes}
        counts = {task.name: JobCount() for task in self.tasks}
        longest_period = max(task.period_ns for task in self.tasks)
        block_length = max(BLOCK_NS, 2 * longest_period)
        for start in range(0, self.end_ns, block_length):
            end = min(start + block_length, self.end_ns)
            chart = self.build_chart(start, end + longest_period)
            for lane in lanes:
                found = count_patterns(chart, lane, (start, end), details[lane.name])
                counted[lane.name].plans.update(found.plans)
                counted[lane.name].cycles.update(found.cycles)
            for task, count in counts.items():
                counts[task] = count + JobCount.count_jobs(chart, task, start, end)
            progress(end / self.end_ns)
        return Panel("measured", self.build_chart(start_ns, end_ns), lanes, counted, counts)

    def _compute_medians(self, lane: Lane) -> dict[Unit, int]:
        """Return the median time, in ns, of each unit function of a lane, including preemption."""
        medians_ns = {}
        for task in (task for task in self.tasks if task.name in lane.tasks):
            rows, _ = self._records[task.name]
            for unit, start, end in UNITS[task.role]:
                medians_ns[unit] = int(np.median(rows[end] - rows[start])) if len(rows) else 0
        return medians_ns

    def find_middle_ns(self, task: TimedTask) -> int:
        """Return the time, in ns, of a task's first release in the second half of the run.

        For a planner, only the releases of plans count. Returns 0 if there is no release.
        """
        ticks = self._records[task.name][0]["tick"]
        index = int(np.searchsorted(ticks, self.end_ns // self.config.tick_ns // 2))
        return int(ticks[index]) * self.config.tick_ns if index < len(ticks) else 0

    @cached_property
    def end_ns(self) -> int:
        """End of the last traced cycle, in ns."""
        layout = self.recording.layout
        end_ticks = [
            int(rows["tick"][-1]) + layout.find_task(task).every
            for task, rows in self.recording.cycles.items()
        ]
        return max(end_ticks, default=0) * self.config.tick_ns

    def build_chart(self, start_ns: int, end_ns: int) -> Chart:
        """Build the chart of the time from `start_ns` to `end_ns`."""
        traced = [
            _TaskTrace(task, self._select_rows(task, start_ns, end_ns), self.config.tick_ns)
            for task in self.tasks
        ]
        spans: list[Span] = []
        for core in {task.core for task in self.tasks}:
            spans += _list_spans([each for each in traced if each.task.core == core])
        jobs = [job for each in traced for job in each.list_jobs()]
        whole = Chart(
            start_ns=0,
            end_ns=self.end_ns,
            spans=tuple(sorted(spans, key=lambda span: (span.start_ns, span.core))),
            jobs=tuple(sorted(jobs, key=lambda job: (job.release_ns, job.task))),
        )
        return whole.cut_window(start_ns, end_ns)

    def _select_rows(self, task: TimedTask, start_ns: int, end_ns: int) -> np.ndarray:
        """Return the trace records of a task that overlap a stretch of time."""
        rows, longest_ns = self._records[task.name]
        # A skipped release is recorded with the next release that is not skipped.
        bounds = (
            (start_ns - longest_ns) // self.config.tick_ns,
            (end_ns + task.every_ns) // self.config.tick_ns + 1,
        )
        first, last = np.searchsorted(rows["tick"], bounds).tolist()
        selected: np.ndarray = rows[first:last]
        return selected

    @cached_property
    def _records(self) -> dict[str, tuple[np.ndarray, int]]:
        """Dictionary from each task to its trace records and its longest response in ns.

        For a planner, only the records of plans are included.
        """
        records = {}
        for task in self.tasks:
            rows = self.recording.read_trace(task.name)
            rows = select_plans(rows) if task.role == "planner" else rows
            records[task.name] = rows, max(compute_response_ns(rows).tolist(), default=0)
        return records


def compute_waking_ns(rows: np.ndarray) -> np.ndarray:
    """Return the processor time in ns that waking up took before the start of each cycle."""
    beyond_stamps = rows["processor_ns"] - compute_duration_ns(rows)
    return np.asarray(np.clip(beyond_stamps, 0, np.maximum(compute_lateness_ns(rows), 0)))


class _TaskTrace(NamedTuple):
    """Trace of one task, with the length of a tick on the wall clock in ns."""

    task: TimedTask
    rows: np.ndarray
    tick_ns: int

    def list_jobs(self) -> Iterator[Job]:
        """Yield the jobs. A release that an executor skipped is a job without an end."""
        every = self.task.every_ns
        skipped_counts = count_skipped_releases(self.rows) * (self.task.role == "executor")
        for release, count, end in zip(
            self._compute_times("release_ns"),
            skipped_counts.tolist(),
            self._compute_times("end_ns"),
            strict=True,
        ):
            for before in range(count, 0, -1):
                yield Job(
                    self.task.name, release - before * every, release - (before - 1) * every, None
                )
            yield Job(self.task.name, release, release + self.task.deadline_ns, end)

    def list_units(self) -> Iterator[tuple[int, Unit, Stretch]]:
        """Yield the release, unit function and stretch of every computation."""
        for unit, *borders in UNITS[self.task.role]:
            stamps = map(self._compute_times, ("release_ns", *borders))
            for release, start, end in zip(*stamps, strict=True):
                if end > start:
                    yield release, unit, (start, end)

    def list_wake_ups(self) -> Iterator[Stretch]:
        """Yield, for each cycle, the stretch directly before it in which the task was waking up."""
        took = compute_waking_ns(self.rows).tolist()
        yield from (
            (start - ns, start)
            for start, ns in zip(self._compute_times("start_ns"), took, strict=True)
            if ns
        )

    def _compute_times(self, stamp: str) -> list[int]:
        """Return a time stamp of all records, in ns since tick 0."""
        # Compute times from the release, because the origin of the machine's clock is arbitrary.
        times_ns: list[int] = (
            self.rows["tick"] * self.tick_ns + self.rows[stamp] - self.rows["release_ns"]
        ).tolist()
        return times_ns


def _list_spans(traced: Sequence[_TaskTrace]) -> Iterator[Span]:
    """Yield the spans of one core, sorted by descending priority.

    Time that tasks of higher priority took is cut out.
    """
    levels: dict[tuple[int, bool], list[tuple[TimedTask, int, Unit, Stretch]]] = defaultdict(list)
    waking: dict[int, list[Stretch]] = defaultdict(list)
    for trace in traced:
        task = trace.task
        for release, unit, stretch in trace.list_units():
            # A critical section runs at its priority ceiling. If it overlaps a task of equal
            # priority, the task ran first, because it cannot preempt the section.
            is_locked = unit is Unit.UPDATE and task.ceiling > task.priority
            priority = task.ceiling if is_locked else task.priority
            levels[-priority, is_locked].append((task, release, unit, stretch))
        if task.role == "executor":
            waking[-task.priority] += trace.list_wake_ups()
    busy: list[Stretch] = []
    for level, is_locked in sorted(levels):
        taken: list[Stretch] = []
        for task, release, unit, stretch in sorted(
            levels[level, is_locked], key=lambda entry: entry[3]
        ):
            for start, end in subtract_stretches(stretch, busy):
                yield Span(task.name, task.core, unit, start, end, release)
                taken.append((start, end))
        busy = merge_stretches([*busy, *taken, *(waking.pop(level, []))])

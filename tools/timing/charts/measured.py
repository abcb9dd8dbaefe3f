"""The Gantt chart of a run, from its trace: spans of unit functions, cut where a higher priority
had the core.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rack.boards.config import RackConfig, rack_timing
from rack.boards.timing.schedule import Chart, Job, Span
from rack.boards.timing.tasks import Budget, TimedTask, Unit
from rack.boards.timing.trace_times import UNITS, plans, response_ns, skipped, waking_ns
from rack.tools.recording.recording import Recording
from rack.tools.timing.charts.panel import Count, Panel, union, without
from rack.tools.timing.charts.patterns import Detail, Lane, Patterns, Stretch, lanes_of, patterns

BLOCK_NS = 1_000_000_000
"""Time of a run that is read at once, so that memory does not grow with its length."""


class TracedRun:
    """A recorded run in the terms of the timing model. Times are ns of the wall clock since tick 0.

    Raises `ConfigError` when a file named by its config is missing.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.config: RackConfig = recording.rack_config
        layout = recording.layout
        known = rack_timing(self.config, layout, dict.fromkeys(self.config.board, Budget())).tasks
        # The cores that the run obtained; the clock leaves no trace.
        self.tasks = tuple(
            replace(t, core=layout.task(t.name).core) for t in known if t.role != "clock"
        )

    @property
    def is_lockstep(self) -> bool:
        """Whether time stood still while tasks computed: such a run has no chart."""
        return self.config.clock.mode == "lockstep"

    def panel(self, start_ns: int, end_ns: int, progress: Callable[[float], None]) -> Panel:
        """Return the panel of a window; `progress` takes the part of the run that is read."""
        lanes = lanes_of(self.tasks)
        details = {lane.name: Detail.measured(lane, self._medians(lane)) for lane in lanes}
        found = {lane.name: Patterns.none() for lane in lanes}
        counts = {task.name: Count() for task in self.tasks}
        reach = max(task.period_ns for task in self.tasks)
        block = max(BLOCK_NS, 2 * reach)
        for at in range(0, self.end_ns, block):
            until = min(at + block, self.end_ns)
            chart = self.chart(at, until + reach)
            for lane in lanes:
                found[lane.name].add(patterns(chart, lane, (at, until), details[lane.name]))
            for task, count in counts.items():
                counts[task] = count + Count.of(chart, task, at, until)
            progress(until / self.end_ns)
        return Panel("measured", self.chart(start_ns, end_ns), lanes, found, counts)

    def _medians(self, lane: Lane) -> dict[Unit, int]:
        """Return the median of each unit function of a lane, preemption included, ns."""
        found = {}
        for task in (task for task in self.tasks if task.name in lane.tasks):
            rows, _ = self._records[task.name]
            for unit, start, end in UNITS[task.role]:
                found[unit] = int(np.median(rows[end] - rows[start])) if len(rows) else 0
        return found

    def middle_ns(self, task: TimedTask) -> int:
        """Return the first release of a task, or of its plans, in the second half of the run; 0
        without one.
        """
        ticks = self._records[task.name][0]["tick"]
        at = int(np.searchsorted(ticks, self.end_ns // self.config.tick_ns // 2))
        return int(ticks[at]) * self.config.tick_ns if at < len(ticks) else 0

    @cached_property
    def end_ns(self) -> int:
        """The end of the last cycle traced."""
        traces = self.recording.cycles.items()
        layout = self.recording.layout
        lasts = [
            int(rows["tick"][-1]) + layout.task(task).every for task, rows in traces if len(rows)
        ]
        return max(lasts, default=0) * self.config.tick_ns

    def chart(self, start_ns: int, end_ns: int) -> Chart:
        """Return the chart of the time from `start_ns` to `end_ns`."""
        traced = [
            _Traced(task, self._cut(task, start_ns, end_ns), self.config.tick_ns)
            for task in self.tasks
        ]
        spans: list[Span] = []
        for core in {task.core for task in self.tasks}:
            spans += _spans([found for found in traced if found.task.core == core])
        jobs = [job for found in traced for job in found.jobs()]
        whole = Chart(
            start_ns=0,
            end_ns=self.end_ns,
            spans=tuple(sorted(spans, key=lambda span: (span.start_ns, span.core))),
            jobs=tuple(sorted(jobs, key=lambda job: (job.release_ns, job.task))),
        )
        return whole.window(start_ns, end_ns)

    def _cut(self, task: TimedTask, start_ns: int, end_ns: int) -> np.ndarray:
        """Return the trace records of a task that extend into a stretch of time."""
        rows, longest_ns = self._records[task.name]
        # A skipped release is in the record of the next one.
        bounds = (
            (start_ns - longest_ns) // self.config.tick_ns,
            (end_ns + task.every_ns) // self.config.tick_ns + 1,
        )
        first, last = np.searchsorted(rows["tick"], bounds).tolist()
        found: np.ndarray = rows[first:last]
        return found

    @cached_property
    def _records(self) -> dict[str, tuple[np.ndarray, int]]:
        """The records of every task, only those of plans for a planner, and its longest response,
        ns.
        """
        found = {}
        for task in self.tasks:
            rows = self.recording.trace(task.name)
            rows = plans(rows) if task.role == "planner" else rows
            found[task.name] = rows, max(response_ns(rows).tolist(), default=0)
        return found


@dataclass(frozen=True)
class _Traced:
    """The trace of one task, with the length of a tick on the wall clock."""

    task: TimedTask
    rows: np.ndarray
    tick_ns: int

    def jobs(self) -> Iterator[Job]:
        """Yield its jobs; a release that an executor skipped is a job that was never done."""
        every = self.task.every_ns
        period = self.task.period_ns
        left_out = skipped(self.rows) * (self.task.role == "executor")
        for release, count, end in zip(
            self._at("release_ns"), left_out.tolist(), self._at("end_ns"), strict=True
        ):
            for missing in range(count, 0, -1):
                yield Job(
                    self.task.name, release - missing * every, release - (missing - 1) * every, None
                )
            yield Job(self.task.name, release, release + period, end)

    def units(self) -> Iterator[tuple[int, Unit, Stretch]]:
        """Yield release, unit function and time of everything it computed."""
        for unit, *borders in UNITS[self.task.role]:
            stamps = map(self._at, ("release_ns", *borders))
            for release, start, end in zip(*stamps, strict=True):
                if end > start:
                    yield release, unit, (start, end)

    def waking(self) -> Iterator[Stretch]:
        """Yield the times before its cycles in which it already had the processor, to wake up."""
        took = waking_ns(self.rows).tolist()
        yield from (
            (start - ns, start) for start, ns in zip(self._at("start_ns"), took, strict=True) if ns
        )

    def _at(self, moment: str) -> list[int]:
        # Relative to its own release: ticks count from 0, the machine's clock from anything.
        found: list[int] = (
            self.rows["tick"] * self.tick_ns + self.rows[moment] - self.rows["release_ns"]
        ).tolist()
        return found


def _spans(traced: Sequence[_Traced]) -> Iterator[Span]:
    """Yield the spans of one core by falling priority, each without the time taken by those above
    it.
    """
    levels: dict[tuple[int, bool], list[tuple[TimedTask, int, Unit, Stretch]]] = defaultdict(list)
    waking: dict[int, list[Stretch]] = defaultdict(list)
    for found in traced:
        task = found.task
        for release, unit, stretch in found.units():
            # A critical section runs at its ceiling: equal priorities cannot preempt it, but it
            # starts after them.
            is_locked = unit is Unit.UPDATE and task.ceiling > task.priority
            priority = task.ceiling if is_locked else task.priority
            levels[-priority, is_locked].append((task, release, unit, stretch))
        if task.role == "executor":
            waking[-task.priority] += found.waking()
    busy: list[Stretch] = []
    for level, is_locked in sorted(levels):
        taken: list[Stretch] = []
        for task, release, unit, stretch in sorted(
            levels[level, is_locked], key=lambda entry: entry[3]
        ):
            for start, end in without(stretch, busy):
                yield Span(task.name, task.core, unit, start, end, release)
                taken.append((start, end))
        busy = union([*busy, *taken, *(waking.pop(level, []))])

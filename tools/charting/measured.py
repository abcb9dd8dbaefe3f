"""The Gantt chart of a run, from its trace: spans of unit functions, each cut where a higher priority had the core."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from rack.backplane.trace import FIELDS, SKIPPED_SHIFT, Flag
from rack.boards.config import RackConfig, rack_timing
from rack.levels.timing.schedule import Chart, Job, Span
from rack.levels.timing.tasks import Budget, TimedTask, Unit
from rack.tools.answer import Failure
from rack.tools.charting.lanes import Lane, lanes_of
from rack.tools.charting.panel import Count, Panel
from rack.tools.charting.patterns import Detail, Patterns, patterns
from rack.tools.charting.stretches import Stretch, union, without
from rack.tools.recording import Recording

SEQUENCES = {
    "executor": (
        ("start_ns", "plan_ns", "read_ns", "process_ns", "end_ns"),
        (Unit.EXCHANGE, Unit.READ, Unit.PROCESS, Unit.WRITE),
    ),
    "planner": (("start_ns", "process_ns", "end_ns"), (Unit.PLAN, Unit.UPDATE)),
}
"""Moments of a trace record, and the unit functions between them; what a planner reads counts to its planning."""
BLOCK_NS = 1_000_000_000
"""Time of a run that is counted at once: an hour's spans need not be held together."""


class Run:
    """A recorded run in the terms of the timing model. Times are ns of the wall clock since tick 0.

    Raises `ConfigError` when what its config names is no longer there, `Failure` for a trace of another kind.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        missing = [name for name in FIELDS if name not in recording.columns]
        if missing:
            raise Failure(f"{recording.folder}: recorded by an earlier rack, its trace has no {', '.join(missing)}", 2)
        self.config: RackConfig = recording.rack_config
        layout = recording.layout
        known = rack_timing(self.config, layout, dict.fromkeys(self.config.board, Budget())).tasks
        # Cores as the run obtained them; of the clock there is no trace.
        self.tasks = tuple(replace(t, core=layout.task(t.name).core) for t in known if t.role != "clock")

    @property
    def is_lockstep(self) -> bool:
        """Whether time stood still while tasks computed: then there is no chart of it."""
        return self.config.clock.mode == "lockstep"

    def panel(self, start_ns: int, end_ns: int, told: Callable[[float], None]) -> Panel:
        """Return the panel of a window; `told` is called with the part of the run that is counted."""
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
                found[lane.name].add(patterns(chart, lane, at, until, details[lane.name]))
            for task, count in counts.items():
                counts[task] = count + Count.of(chart, task, at, until)
            told(until / self.end_ns)
        return Panel("measured", self.chart(start_ns, end_ns), lanes, found, counts)

    def _medians(self, lane: Lane) -> dict[Unit, int]:
        """Return what each unit function of a lane takes in the median, preemption included, ns."""
        found = {}
        for task in (task for task in self.tasks if task.name in lane.tasks):
            rows, _ = self._records[task.name]
            moments, units = SEQUENCES[task.role]
            for unit, (start, end) in zip(units, pairwise(moments), strict=True):
                found[unit] = int(np.median(rows[end] - rows[start])) if len(rows) else 0
        return found

    def middle_ns(self, task: TimedTask) -> int:
        """Return the first release of a task, or of a plan of it, in the second half of the run; without one, 0."""
        ticks = self._records[task.name][0]["tick"]
        at = int(np.searchsorted(ticks, self.end_ns // self._tick_ns // 2))
        return int(ticks[at]) * self._tick_ns if at < len(ticks) else 0

    @cached_property
    def end_ns(self) -> int:
        """The end of the last cycle traced."""
        lasts = [int(rows["tick"][-1]) + self.recording.layout.task(t).every for t, rows in self._rows]
        return max(lasts, default=0) * self._tick_ns

    @property
    def _rows(self) -> Iterator[tuple[str, np.ndarray]]:
        yield from ((task, rows) for task, rows in self.recording.cycles.items() if len(rows))

    @cached_property
    def _tick_ns(self) -> int:
        return round(self.config.clock_ns / self.config.clock.speed)

    def chart(self, start_ns: int, end_ns: int) -> Chart:
        """Return what is traced of the time from `start_ns` to `end_ns`."""
        traced = [_Traced(task, self._cut(task, start_ns, end_ns), self._tick_ns) for task in self.tasks]
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
        """Return the trace records of a task that reach into a stretch of time."""
        rows, longest_ns = self._records[task.name]
        # A release that was skipped stands in the record of the next one.
        bounds = (start_ns - longest_ns) // self._tick_ns, (end_ns + task.every_ns) // self._tick_ns + 1
        first, last = np.searchsorted(rows["tick"], bounds).tolist()
        found: np.ndarray = rows[first:last]
        return found

    @cached_property
    def _records(self) -> dict[str, tuple[np.ndarray, int]]:
        """The records of every task, those of plans alone for a planner, and its longest response, ns."""
        found = {}
        for task in self.tasks:
            rows = self.recording.cycles.get(task.name, self.recording.no_cycles)
            if task.role == "planner":
                rows = rows[(rows["flags"] & Flag.PLANNED) > 0]
            found[task.name] = rows, max((rows["end_ns"] - rows["release_ns"]).tolist(), default=0)
        return found


@dataclass(frozen=True)
class _Traced:
    """The trace of one task: records, and one tick of the wall clock, ns."""

    task: TimedTask
    rows: np.ndarray
    tick_ns: int

    def jobs(self) -> Iterator[Job]:
        """Yield its jobs; what an executor skipped is one that was never done."""
        every, period = self.task.every_ns, self.task.period_ns
        for tick, flags, end in zip(self._column("tick"), self._column("flags"), self._at("end_ns"), strict=True):
            release = tick * self.tick_ns
            skipped = flags >> SKIPPED_SHIFT if self.task.role == "executor" else 0
            for missing in range(skipped, 0, -1):
                yield Job(self.task.name, release - missing * every, release - (missing - 1) * every, None)
            yield Job(self.task.name, release, release + period, end)

    def units(self) -> Iterator[tuple[int, Unit, Stretch]]:
        """Yield release, unit function and time of everything it computed."""
        names, units = SEQUENCES[self.task.role]
        moments = [self._at(name) for name in names]
        for tick, *times in zip(self._column("tick"), *moments, strict=True):
            for unit, (start, end) in zip(units, pairwise(times), strict=True):
                if end > start:
                    yield tick * self.tick_ns, unit, (start, end)

    def waking(self) -> Iterator[Stretch]:
        """Yield the times before its cycles in which it had the processor already, to wake up."""
        rows = self.rows
        used = rows["processor_ns"] - (rows["end_ns"] - rows["start_ns"])
        late = rows["start_ns"] - rows["release_ns"]
        took = np.clip(used, 0, np.maximum(late, 0)).tolist()
        yield from ((start - ns, start) for start, ns in zip(self._at("start_ns"), took, strict=True) if ns)

    def _at(self, moment: str) -> list[int]:
        # Against its own release: the grid is the rack's, whatever the machine's clock began with.
        found: list[int] = (self.rows["tick"] * self.tick_ns + self.rows[moment] - self.rows["release_ns"]).tolist()
        return found

    def _column(self, name: str) -> list[int]:
        found: list[int] = self.rows[name].tolist()
        return found


def _spans(traced: Sequence[_Traced]) -> Iterator[Span]:
    """Yield the spans of one core: the highest priority first, each without what those above it took."""
    levels: dict[tuple[int, bool], list[tuple[TimedTask, int, Unit, Stretch]]] = defaultdict(list)
    waking: dict[int, list[Stretch]] = defaultdict(list)
    for found in traced:
        task = found.task
        for release, unit, stretch in found.units():
            # The critical section: nobody of its ceiling takes it the core, but it begins behind them.
            is_locked = unit is Unit.UPDATE and task.ceiling > task.priority
            levels[-(task.ceiling if is_locked else task.priority), is_locked].append((task, release, unit, stretch))
        if task.role == "executor":
            waking[-task.priority] += found.waking()
    busy: list[Stretch] = []
    for level, is_locked in sorted(levels):
        taken: list[Stretch] = []
        for task, release, unit, stretch in sorted(levels[level, is_locked], key=lambda entry: entry[3]):
            for start, end in without(stretch, busy):
                yield Span(task.name, task.core, unit, start, end, release)
                taken.append((start, end))
        busy = union([*busy, *taken, *(waking.pop(level, []))])

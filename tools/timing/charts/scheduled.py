"""The panel of a schedule, which is simulated from the budgets of a config."""

from __future__ import annotations

from dataclasses import replace
from math import lcm
from typing import Any

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, build_rack_timing
from rack.boards.timing.frames import compute_core_frames
from rack.boards.timing.schedule import simulate_schedule
from rack.tools.console.answer import Failure
from rack.tools.timing.charts.panel import JobCount, Panel
from rack.tools.timing.charts.patterns import PatternDetail, build_lanes, count_patterns

MIN_SLICES = 10
"""Minimum number of the slowest task's slices over which patterns are counted."""
MAX_DEFAULT_FRAMES = 24
"""Maximum number of minor frames of a static schedule in a default chart."""
MAX_SIMULATED_CYCLES = 1_000_000
"""Maximum number of simulated cycles of all tasks, which take about a minute."""


class Schedule:
    """The simulated schedule of all tasks that have a budget. At least one task must have one.

    Attributes:
        tasks: Tasks with their cores and priorities.
        frame_ns: Minor frame of a static schedule, ns. 0 if there is none.
        default_length_ns: Default length of a chart of a static schedule, ns. None if the schedule
            is not static.
        switch_ns: Time of a context switch, ns.
    """

    def __init__(self, config: RackConfig, layout: Layout) -> None:
        timing = build_rack_timing(config, layout)
        self.tasks = timing.tasks
        self._tick_ns = timing.tick_ns
        self.frame_ns = 0 if timing.schedule is None else timing.schedule.minor * timing.tick_ns
        # Show the frames of a static schedule up to the last one that differs from earlier ones.
        alike = [each.frames[0] for each in compute_core_frames(timing)]
        self.default_length_ns = (
            min(max(alike) + 1, MAX_DEFAULT_FRAMES) * self.frame_ns if alike else None
        )
        self.switch_ns = timing.context_switch_ns

    def move_to_cores(self, layout: Layout) -> None:
        """Move the tasks to the cores that a run obtained."""
        of_run = {task.name: task.core for task in layout.tasks}
        self.tasks = tuple(
            replace(task, core=of_run.get(task.name, task.core)) for task in self.tasks
        )

    @property
    def shortest_ns(self) -> int:
        """Duration, in ns, of the shortest part of any task."""
        return min((part.time_ns for task in self.tasks for part in task.parts), default=1)

    def build_panel(self, start_ns: int, end_ns: int) -> Panel:
        """Simulate the schedule and return the panel of a window.

        Raises:
            Failure: If too many cycles would have to be simulated.
        """
        # The schedule repeats after the least common multiple of all slices. If tasks have phases,
        # the first repetition differs.
        period_ns = lcm(*(task.period_ns for task in self.tasks))
        has_phases = any(task.phase_ns for task in self.tasks)
        skipped_ns = max(0, start_ns // period_ns - has_phases) * period_ns
        longest_ns = max(task.period_ns for task in self.tasks)
        counted_ns = MIN_SLICES * longest_ns
        until_ns = max(end_ns - skipped_ns, counted_ns + longest_ns)
        if (jobs := sum(until_ns // task.period_ns for task in self.tasks)) > MAX_SIMULATED_CYCLES:
            raise Failure(
                f"no schedule: {MIN_SLICES} slices of the slowest task,"
                f" {longest_ns * 1e-6:g} ms each, hold {jobs} cycles of all tasks;"
                f" at most {MAX_SIMULATED_CYCLES} are simulated",
                2,
            )
        chart = simulate_schedule(self.tasks, until_ns, self.switch_ns, tick_ns=self._tick_ns)
        shown = chart.cut_window(start_ns - skipped_ns, end_ns - skipped_ns)
        lanes = build_lanes(self.tasks)
        detail = PatternDetail(gap_ns=2 * self.switch_ns)
        return Panel(
            kind="schedule",
            chart=replace(
                _shift_times(shown, skipped_ns),
                spans=tuple(_shift_times(span, skipped_ns) for span in shown.spans),
                jobs=tuple(_shift_times(job, skipped_ns) for job in shown.jobs),
            ),
            lanes=lanes,
            patterns={
                lane.name: count_patterns(chart, lane, (0, counted_ns), detail) for lane in lanes
            },
            counts={
                task.name: JobCount.count_jobs(chart, task.name, 0, counted_ns)
                for task in self.tasks
            },
            frame_ns=self.frame_ns,
        )


def _shift_times(entry: Any, by_ns: int) -> Any:
    """Return a chart, span or job with all its own times increased by `by_ns`."""
    times = {name: time for name, time in vars(entry).items() if name.endswith("_ns")}
    shifted = {name: time + by_ns for name, time in times.items() if time is not None}
    return replace(entry, **shifted)

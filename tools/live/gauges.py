"""What the full screen of `rack top` shows of a rack beyond its snapshot: worst times, shares of
time slices, plan ages, commands in work, and what passes through the mailboxes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import ceil

import numpy as np

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.words import Box, System
from rack.levels.timing.trace_times import communication_ns, execution_ns, lateness_ns
from rack.tools.console.tables import decimal

BAR = 7
"""Length of the bar of a time slice, in characters."""
LATE_US = (0, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, np.inf)
"""Borders of the lateness histogram."""


class Gauges:
    """Reads rings and words of one rack, at each look."""

    def __init__(self, segment: Segment) -> None:
        layout = segment.layout
        self._segment = segment
        self._tick_s = layout.clock_ns * 1e-9
        self._tasks = {task.name: task for task in layout.tasks}
        self._boxes = {box.name: open_observer(segment, box.name) for box in layout.mailboxes}
        names = [task.name for task in sorted(layout.tasks, key=lambda task: -task.every)]
        self.levels = [name for name in names if f"{name}.operator" in self._boxes] or names
        """Levels that take an operator's commands, or else all tasks, slowest first."""
        self._statuses = {
            box.writer: MailboxRing(segment, box.name)
            for box in layout.mailboxes
            if box.name == f"{box.writer}.status" and "echo" in {field.name for field in box.fields}
        }
        self._work = dict.fromkeys(self._statuses, (0, 0))
        self._shares = dict.fromkeys(self._tasks, (0.0, 0.0))
        self.reset()

    def reset(self) -> None:
        """Forget the worst times and the lateness so far."""
        self.worst_ms = {task: np.zeros(2) for task in self._tasks}  # lateness, execution
        self.late = {task: np.zeros(len(LATE_US) - 1, int) for task in self._tasks}  # cycles

    def take(self, cycles: Mapping[str, np.ndarray]) -> None:
        """Take in new trace records, by task, and new statuses."""
        for task, rows in cycles.items():
            if len(rows):
                self._measure(task, rows)
        for level, ring in self._statuses.items():
            rows = ring.drain().rows
            for tick, echo in zip(rows["tick"], rows["message"]["echo"], strict=True):
                if echo != self._work[level][0]:
                    self._work[level] = (echo, tick)

    def _measure(self, task: str, rows: np.ndarray) -> None:
        late = np.maximum(lateness_ns(rows), 0)
        execution = execution_ns(rows)
        self.late[task] += np.histogram(late * 1e-3, LATE_US)[0]
        self.worst_ms[task] = np.maximum(
            self.worst_ms[task], (late.max() * 1e-6, execution.max() * 1e-6)
        )
        spec = self._tasks[task]
        slice_ns = spec.slice * self._segment.words[System.PERIOD_NS]
        self._shares[task] = (execution.mean() / slice_ns, communication_ns(rows).mean() / slice_ns)

    def bar(self, task: str) -> str:
        """Return the time slice of a task as a bar: execution, communication, residual time."""
        execution, communication = self._shares[task]
        used = "█" * ceil(BAR * execution) + "▒" * ceil(BAR * communication)
        return used[:BAR].ljust(BAR, "·")

    def work(self, task: str) -> str:
        """Return the command in work as text: its serial, and since when, s; empty: none."""
        serial, since = self._work.get(task, (0, 0))
        return f"{serial} {since * self._tick_s:.0f}s" if serial else ""

    def age_s(self, mailbox: str) -> float | None:
        """Return the age of the newest visible message, simulated s; None without one."""
        box = self._boxes.get(mailbox)
        tick = self._segment.words[System.TICK]
        if box is None or not box.read(tick).is_there:
            return None
        return (tick - box.newest) * self._tick_s

    def traffic(self) -> Iterator[list[str]]:
        """Yield for each mailbox its name, writer and readers, the age of its newest message, s,
        and its mean messages per s of the run; simulated time."""
        time_s = max(self._segment.words[System.TICK], 1) * self._tick_s
        for name, box in self._boxes.items():
            readers = ", ".join(box.spec.readers)
            rate_hz = self._segment.box(name)[Box.HEAD] / time_s
            yield [name, box.spec.writer, readers, decimal(self.age_s(name)), decimal(rate_hz, 1)]

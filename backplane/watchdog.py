"""The watchdog of the system controller: finds tasks that do not answer their releases.

A release without an answer is a miss, and no more: on a busy machine any process may lose its core for a while. A
task is called lost only when something proves it: a signal has stopped its process, or it waits for something else than
its release, or it has used so much processor time that it will not end. One that gets no processor time is starved.
"""

from __future__ import annotations

from rack.backplane.alarms import Alarm, AlarmWriter
from rack.backplane.process import STOPPED, WAITING, processor_ns, state_of
from rack.backplane.released_task import ReleasedTask
from rack.backplane.words import Block

BEATS = 4
"""Releases without an answer after which a task is looked at: three gave a false trip in 24,000 at 400 Hz."""
LEAST_NS = 1_000_000_000
"""Least processor time, or time of waiting, after which a silent task is called hanging."""


class Watchdog:
    """Looks at a task that was released before it has answered. `losses` counts the tasks found hanging."""

    def __init__(self, alarms: AlarmWriter, period_ns: int) -> None:
        self._alarms = alarms
        self._period_ns = period_ns
        self.losses = 0
        self._used_ns: dict[int, int] = {}  # task -> processor time when it was looked at first

    def look(self, task: ReleasedTask, tick: int) -> None:
        """Tell of a task whose newest release but one is unanswered at `tick`, and find out whether it hangs."""
        missing, spec = task.unanswered, task.spec
        if missing == 1:
            late = Alarm.LATE if spec.role == "executor" else Alarm.PLAN_LATE
            self._alarms.ring(tick, late, task.index, missing, task.block[Block.DONE])
        if missing < BEATS:
            return
        if missing == BEATS:
            self._used_ns[task.index] = processor_ns(task.block[Block.PID])
        if self._hangs(task):
            self.losses += 1
            task.lose(tick)
            self._alarms.ring(tick, Alarm.HANG, task.index, missing, tick - missing * spec.every)
        elif missing == BEATS:
            self._alarms.ring(tick, Alarm.STARVED, task.index, missing, tick - missing * spec.every)

    def _hangs(self, task: ReleasedTask) -> bool:
        spec, pid = task.spec, task.block[Block.PID]
        state = state_of(pid)
        if state in STOPPED:
            return True
        bound_ns = max(LEAST_NS, BEATS * spec.every * spec.within_cycles * self._period_ns)
        if task.unanswered * spec.every * self._period_ns <= bound_ns:
            return False
        return state in WAITING or processor_ns(pid) - self._used_ns.get(task.index, 0) > bound_ns

"""Changes of a board's scheduler by an operator, while the rack runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.process import DEADLINE, reserve_time, set_priority
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import SCHEDULERS, Block, Scheduler, System
from rack.boards.wiring import Scheduling


class SchedulerChanges:
    """Changes the schedulers of tasks for operators. The clock does so, even if a task is starved.

    Args:
        segment: Memory of the rack.
        tasks: The clock's access to the tasks.
        schedulings: How executors compete for their cores, by task.
        alarms: Alarm ring of the clock.
    """

    def __init__(
        self,
        segment: Segment,
        tasks: Sequence[ReleasedTask],
        schedulings: Mapping[str, Scheduling],
        alarms: AlarmWriter,
    ) -> None:
        self._tasks = {task.spec.name: task for task in tasks}
        self._schedulings = schedulings
        self._alarms = alarms
        self._is_lockstep = bool(segment.words[System.LOCKSTEP])

    def change_scheduler(self, name: str, word: str, tick: int) -> None:
        """Change the scheduler of an executor, or report why the system refuses.

        Args:
            name: Name of the executor, which is that of its board.
            word: Name of its new scheduler. Any other word has no effect.
            tick: Current tick.
        """
        scheduler = SCHEDULERS.get(word)
        if scheduler is None or name not in self._schedulings:
            return
        task = self._tasks[name]
        if why := "" if self._is_lockstep else self._switch_process(task, scheduler):
            self._alarms.raise_alarm(tick, Alarm.SCHEDULER_KEPT, task.index, scheduler, text=why)
        else:
            task.block[Block.SCHEDULER] = scheduler

    def _switch_process(self, task: ReleasedTask, scheduler: Scheduler) -> str:
        """Give the process of a task another scheduler. Return why the system refuses, or ""."""
        pid = task.block[Block.PID]
        priority = task.spec.priority
        if scheduler is Scheduler.MAXIMUM_URGENCY_FIRST:
            return "Linux has no such scheduler"
        if scheduler is Scheduler.EARLIEST_DEADLINE_FIRST:
            priority = DEADLINE
            scheduling = self._schedulings[task.spec.name]
            # A clock with a priority would run below a board with a deadline on its core.
            for reservation, process in ((scheduling.clocks, 0), (scheduling.reservation, pid)):
                if reservation is not None and (why := reserve_time(reservation, process)):
                    return why
        elif not set_priority(priority, pid):
            return "SCHED_FIFO is not permitted"
        task.block[Block.PRIORITY] = priority
        return ""

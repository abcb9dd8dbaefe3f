"""Scheduler of a board: taken at the start, and changed by its operator between two cycles."""

from __future__ import annotations

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.process import DEADLINE, reserve_time, set_priority, take_core
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, Scheduler, System
from rack.boards.wiring import TaskWiring
from rack.levels.operator import Operation

EARLIEST = Scheduler.EARLIEST_DEADLINE_FIRST
BY_NAME = {scheduler.word: scheduler for scheduler in Scheduler}


def take_scheduled_core(segment: Segment, wiring: TaskWiring) -> None:
    """Pin the calling process to the core of its task, and give it the task's scheduler.

    After a restart this is the scheduler that the previous process had.
    """
    spec = segment.layout.find_task(wiring.task)
    block = segment.get_block(wiring.task)
    reservation = None
    if wiring.scheduling is not None:
        block[Block.SCHEDULER] = block[Block.SCHEDULER] or wiring.scheduling.scheduler
        if block[Block.SCHEDULER] == EARLIEST:
            reservation = wiring.scheduling.reservation
    block[Block.PRIORITY] = take_core(spec.core, spec.priority, reservation)
    block[Block.CORE] = spec.core


class SchedulerCommands:
    """Changes the scheduler of a board as its operator commands.

    Args:
        segment: Memory of the rack.
        wiring: Wiring of the board's executor.
        alarms: Alarm ring of the executor.
    """

    def __init__(self, segment: Segment, wiring: TaskWiring, alarms: AlarmWriter) -> None:
        self._block = segment.get_block(wiring.task)
        self._words = segment.words
        self._spec = segment.layout.find_task(wiring.task)
        self._index = segment.layout.processes.index(self._spec)
        self._scheduling = wiring.scheduling
        self._alarms = alarms
        self._commands = open_observer(segment, f"{self._spec.board}.operator")

    def take_commands(self, tick: int) -> None:
        """Carry out the new commands that concern the scheduler."""
        reading = self._commands.read(tick)
        if not reading.is_new:
            return
        for message in (*reading.earlier, reading.message):
            scheduler = BY_NAME.get(message.name)
            if message.what == Operation.SCHEDULE and scheduler is not None:
                if why := "" if self._words[System.LOCKSTEP] else self._switch_process(scheduler):
                    self._alarms.raise_alarm(
                        tick, Alarm.SCHEDULER_KEPT, self._index, scheduler, text=why
                    )
                else:
                    self._block[Block.SCHEDULER] = scheduler

    def _switch_process(self, scheduler: Scheduler) -> str:
        """Give this process another scheduler. Return why the system refuses, or an empty text."""
        if scheduler is not EARLIEST:
            is_refused = not set_priority(self._spec.priority)
            self._block[Block.PRIORITY] = 0 if is_refused else self._spec.priority
            return "SCHED_FIFO is not permitted" if is_refused else ""
        # A clock with a priority would run below a board with a deadline on its core.
        scheduling = self._scheduling
        assert scheduling is not None, "the config names schedulers"
        for pid, reservation in (
            (self._words[System.CLOCK_PID], scheduling.clocks),
            (0, scheduling.reservation),
        ):
            if reservation is not None and (why := reserve_time(reservation, pid)):
                return why
        self._block[Block.PRIORITY] = DEADLINE
        return ""

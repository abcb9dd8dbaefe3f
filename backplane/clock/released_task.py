"""The clock's access to a task, and the watchdog for tasks that do not respond to releases.

A release is missed if the task has not finished the one before. That alone does not prove a fault,
because on a busy machine any process may be preempted for a while. A task counts as hanging, and so
as lost, only if a signal has stopped its process, if it waits although it has a release, or if it
has used so much processor time that its cycle will not end. A task that gets no processor time
counts as starved.
"""

from __future__ import annotations

from collections.abc import Callable

from rack.backplane.layout import Layout, TaskSpec
from rack.backplane.process import STOPPED_STATES, WAITING_STATES, read_processor_ns, read_state
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore, get_wake_semaphore
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, TaskState

RELEASES_MISSED = 4
"""Number of missed releases before a task is checked.

Three gave one false alarm in 24,000 cycles at 400 Hz.
"""
MIN_HANG_NS = 1_000_000_000
"""Minimum time that a task must wait or compute without finishing before it is found hanging."""


class ReleasedTask:
    """The clock's access to a task's control block.

    Attributes:
        index: Index of the task in the layout.
        sleeps: True if in real time the task wakes itself at its grid points with a timer.
        is_posted: True if the task waits for its semaphore, which `wake()` posts. False if it
            polls.
        done: Semaphore that the task posts in lockstep to report a finished release.
        missed: Number of consecutive releases missed. At most 2 as long as the task still finishes
            releases, however late.
        deadline: Tick before which the task must finish its release or plan, or send its messages
            if these are due earlier. It is computed from a word of the control block, which the
            task changes to a later tick when it begins a plan.
        is_stopped: True if a signal has stopped the task's process, so that lockstep must not wait
            for it.
    """

    def __init__(self, segment: Segment, spec: TaskSpec) -> None:
        self.spec = spec
        self.index = segment.layout.processes.index(spec)
        self.block = segment.get_block(spec.name)
        self.sleeps = spec.wake == "timer"
        self.is_posted = spec.wake != "poll"
        self.missed = 0
        self.is_stopped = False
        self.deadline = self.block[Block.DEADLINE]
        self._every = spec.every
        self._phase = spec.phase
        self._early = spec.slice - segment.layout.compute_due_ticks(spec)
        self._done = self.block[Block.DONE]
        self.wake: Callable[[], object] = get_wake_semaphore(segment, spec.name).release
        self.done = get_done_semaphore(segment, spec.name)

    def can_take_release(self, release: int) -> bool:
        """Check that at tick `release` the task is neither lost nor still working on a plan."""
        return self.block[Block.DEADLINE] <= release and not self.is_lost

    def release(self, tick: int, more: int = 0) -> None:
        """Release the task, and update `missed` and its deadline.

        Args:
            tick: Current tick. The task gets its newest release that is not after this tick.
            more: Number of further releases that it gets at once, for a batch in lockstep.
        """
        block = self.block
        every = self._every
        release = tick - (tick - self._phase) % every
        if self.is_stopped:
            self.check_stopped()
        done = block[Block.DONE]
        if done == block[Block.RELEASED]:
            self.missed = 0
        elif done != self._done:
            self.missed = min(self.missed + 1, 2)
        else:
            self.missed += 1
        self._done = done
        newest = release + more * every
        block[Block.DEADLINE] = newest + every
        self.deadline = newest + every - self._early
        block[Block.FIRST] = release
        block[Block.RELEASED] = newest

    def find_next_event(self, tick: int) -> int:
        """Return the task's deadline if it is after `tick`, otherwise its next release tick.

        If a cycle takes simulated time, return the tick at which it continues.
        """
        if finish := self.block[Block.FINISH]:
            return finish
        if self.deadline > tick:
            return self.deadline
        return tick + 1 + (self._phase - tick - 1) % self._every

    def is_settled(self) -> bool:
        """Check whether the task has finished its last release, or waits, is lost or is stopped.

        A task waits during a cycle if the cycle takes simulated time.
        """
        block = self.block
        return (
            block[Block.DONE] == block[Block.RELEASED]
            or self.is_waiting
            or self.is_lost
            or self.is_stopped
        )

    def is_finished(self, tick: int) -> bool:
        """Return True if the task is settled or its deadline is after `tick`.

        The clock may then begin `tick` without waiting for the task.
        """
        self.deadline = self.block[Block.DEADLINE] - self._early
        return self.deadline > tick or self.is_settled()

    def check_stopped(self) -> None:
        """Update `is_stopped` from the state of the task's process."""
        self.is_stopped = read_state(self.block[Block.PID]) in STOPPED_STATES

    @property
    def is_waiting(self) -> bool:
        """True if a cycle takes simulated time and its task waits for a later tick, in lockstep."""
        return self.block[Block.FINISH] != 0

    def resume(self) -> None:
        """Continue the cycle of a waiting task."""
        self.block[Block.FINISH] = 0
        self.wake()

    @property
    def is_lost(self) -> bool:
        """True if the task was found lost and has not rejoined."""
        return bool(self.block[Block.LOST])

    @property
    def lost_tick(self) -> int:
        """Tick at which the task was found lost, -1 if it is not lost."""
        return self.block[Block.LOST] - 1

    @property
    def is_ready(self) -> bool:
        """True if a lost task has a new process that has completed its start-up.

        For a host board, the new process may also have ended already.
        """
        return self.block[Block.STATE] in (TaskState.READY, TaskState.RUNNING, TaskState.ENDED)

    @property
    def is_given_up(self) -> bool:
        """True if a lost task will not be restarted."""
        return self.block[Block.STATE] == TaskState.GIVEN_UP

    def mark_lost(self, tick: int) -> None:
        """Mark the task as lost at `tick`. It gets no releases until its new process rejoins."""
        self.block[Block.STATE] = TaskState.ABSENT
        self.block[Block.LOST] = tick + 1

    def admit_new_process(self) -> None:
        """Mark the task as no longer lost, so that its new process gets the task's next release."""
        block = self.block
        block[Block.DONE] = block[Block.RELEASED]
        block[Block.DEADLINE] = block[Block.FINISH] = 0
        self.missed = 0
        self.is_stopped = False
        block[Block.LOST] = 0


def sort_by_priority(layout: Layout) -> list[TaskSpec]:
    """Return the tasks in the order in which the clock releases them.

    Executors come first, then planners, each sorted from the highest rate to the lowest.
    """
    return sorted(layout.tasks, key=lambda t: (t.role == "planner", t.every, t.phase, t.slot))


class Watchdog:
    """Detects late, starved and hanging tasks. `losses` is the number of tasks found hanging."""

    def __init__(self, alarms: AlarmWriter, period_ns: int) -> None:
        self._alarms = alarms
        self._period_ns = period_ns
        self.losses = 0
        self._used_ns: dict[int, int] = {}  # task -> processor time when it was first checked

    def check(self, task: ReleasedTask, tick: int) -> None:
        """Check a task that has missed releases, and raise alarms about it.

        The first missed release raises an alarm. Once `RELEASES_MISSED` are missed, the task is
        marked as lost if it hangs. Otherwise it is reported once as starved.
        """
        missed = task.missed
        spec = task.spec
        if missed == 1:
            late = Alarm.PLAN_LATE if spec.role == "planner" else Alarm.LATE
            self._alarms.raise_alarm(tick, late, task.index, missed, task.block[Block.DONE])
        if missed < RELEASES_MISSED:
            return
        if missed == RELEASES_MISSED:
            self._used_ns[task.index] = read_processor_ns(task.block[Block.PID])
        if self._is_hanging(task):
            self.losses += 1
            task.mark_lost(tick)
            found = Alarm.HANG
        elif missed == RELEASES_MISSED:
            found = Alarm.STARVED
        else:
            return
        self._alarms.raise_alarm(tick, found, task.index, missed, tick - missed * spec.every)

    def _is_hanging(self, task: ReleasedTask) -> bool:
        """Check whether a task hangs: it is stopped, or has waited or computed for too long.

        A task whose cycle takes simulated time does not hang, because the end of its cycle is
        known.
        """
        spec = task.spec
        pid = task.block[Block.PID]
        state = read_state(pid)
        if state in STOPPED_STATES:
            return True
        if task.is_waiting:
            return False
        bound_ns = max(MIN_HANG_NS, RELEASES_MISSED * spec.slice * self._period_ns)
        if task.missed * spec.every * self._period_ns <= bound_ns:
            return False
        return (
            state in WAITING_STATES
            or read_processor_ns(pid) - self._used_ns.get(task.index, 0) > bound_ns
        )

"""The clock in lockstep: a tick begins when every task due before it has finished.

Tasks on different cores run at the same time. Each task posts its own semaphore to report that it
has finished a release. The clock waits for one task at a time, beginning with the task that
finished last in the previous tick. The others have usually finished by then, so the clock wakes up
once per tick. Alternatives considered: one semaphore for all tasks (the clock wakes up for every
report and takes the core from a task that is still working), and a word that names the awaited task
(it needs a memory barrier on each side).

If an executor is the only task due in the next ticks, it gets their releases as one batch. Separate
ticks would each cost two context switches and the clock's work, together a fifth of a tick of
`k1607`. During a batch no other task is released, no message of another task becomes visible, and
the clock has nothing to do, so the executor reads and writes the same messages as without it.

Computing takes no simulated time, unless a task states the tick at which its cycle continues. The
task then waits in the middle of the cycle, and the clock does not wait for the task before that
tick. In the meantime the clock releases the task as in real time, and the task misses these
releases.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from rack.backplane.clock.driver import ClockDriver, FindEndTick
from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.clock.wake import CHECK_NS
from rack.backplane.process import ENDED_STATES, STOPPED_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.words import Block, Run, System

MAX_RECORDER_WAIT_S = 30.0
"""Maximum time to wait for a recorder that is stopped or dead.

The launcher replaces a dead recorder much sooner.
"""
MAX_BATCH_TICKS = 8
"""Maximum number of ticks in a batch. A request from the host takes effect after the batch."""
POLL_S = 0.001
"""Time between two checks while the clock waits for the recorder or, at first, for the host.

These processes must not be able to disturb the clock, so they have no semaphore to post.
"""
MAX_POLL_S = 0.016
"""Longest time between two checks while the host holds the rack."""


class LockstepDriver(ClockDriver):
    """Driver of the clock in lockstep.

    Attributes:
        snapshot: Function that takes a snapshot before a tick if one is due, and returns the next
            tick before which it must be called. Initially a function that does nothing.
        permits_batches: False if cycles may take simulated time at any tick.
    """

    def __init__(
        self,
        segment: Segment,
        ended: FindEndTick,
        one_at_a_time: bool,
        history_ticks: int,
        alarms: AlarmWriter | None = None,
    ) -> None:
        """Create the driver.

        Args:
            segment: Memory of the rack.
            ended: Returns the tick before which the run stops, once known.
            one_at_a_time: True to release the tasks of a tick one after the other, including
                planners, and to wait for each of them. Runs with protocols whose messages are
                visible at once repeat exactly only in this way. While a task floods a mailbox,
                the driver does this in any case, because the task would overwrite messages that
                others read in the same tick.
            history_ticks: Number of ticks by which a recorder may be behind before its rings
                overflow.
            alarms: Alarm ring of the clock. None to open it here.
        """
        super().__init__(segment, ended, alarms)
        self._one_at_a_time = one_at_a_time
        self._history_ticks = history_ticks
        self._last_first = list(reversed(self.tasks))
        self.snapshot: Callable[[int], int] = lambda tick: sys.maxsize
        self._snapshot_at = 0
        self.permits_batches = not one_at_a_time
        # The configured end of a run that continues another may be before its first tick. This run
        # then ends at once.
        self._next = self.first_tick
        self._last = self._next - 1

    def run(self) -> None:
        """Run the clock until the run is over or the launcher has ended."""
        self.words[System.STATE] = Run.RUNNING
        # After a restart of the clock, tasks may still be working on a batch of the old process.
        self.wait_until_settled()
        while self._wait_for_tick(tick := self._next):
            if not self.begin_tick(tick):
                self._next = tick + 1
                continue
            due = self.list_due_tasks(tick, self._last)
            end = self._find_batch_end(due, tick)
            if not self._run_ticks(due, tick, end):
                break
            self._last = self.words[System.TICK] = end - 1
            self._next = end
        self.end_run()

    def _wait_for_tick(self, tick: int) -> bool:
        """Take a snapshot if one is due, then wait until the host and the recorder permit `tick`.

        Returns:
            False if the run ends before `tick`.
        """
        # Take the snapshot before any work for this tick, because a run that continues from it
        # begins with this tick.
        if tick >= self._snapshot_at:
            self._snapshot_at = self.snapshot(tick)
        return (
            self._wait_for_step(tick) and not self.is_over(tick) and self._wait_for_follower(tick)
        )

    def _find_batch_end(self, due: list[ReleasedTask], tick: int) -> int:
        """Return the first tick after the batch that begins at `tick`.

        At the ticks of a batch, nothing is due except the cycles of one executor. If no batch can
        begin at `tick`, the result is `tick` + 1.
        """
        controller = self.controller
        if len(due) != 1 or controller is None or not self.permits_batches:
            return tick + 1
        (alone,) = due
        # An executor with a longer period needs no batch, because further ticks may begin while its
        # cycle is still running.
        if alone.spec.every > 1 or alone.spec.role != "executor":
            return tick + 1
        if alone.is_stopped or alone.is_waiting:
            return tick + 1
        end = min(tick + MAX_BATCH_TICKS, self._snapshot_at, controller.find_next_work_tick(tick))
        if stop := self.words[System.STOP_TICK]:
            end = min(end, stop)
        if (hold := self.words[System.HOLD_AT]) > 0:
            end = min(end, hold - 1)
        for task in self.tasks:
            if end <= tick + 1:
                break
            if task is not alone:
                end = min(end, task.find_next_event(tick))
        return max(end, tick + 1)

    def _run_ticks(self, due: list[ReleasedTask], tick: int, end: int) -> bool:
        """Release the due tasks, and wait until tick `end` may begin.

        Args:
            due: Tasks to be released at `tick`.
            tick: Current tick.
            end: First tick after the batch, or `tick` + 1 without a batch.

        Returns:
            False if the launcher has ended or the host requests the end of the run.
        """
        one_at_a_time = self._one_at_a_time or self.is_flooded
        for task in due:
            task.release(tick, end - tick - 1)
            if task.is_posted:
                task.wake()
            if one_at_a_time and not self.await_state(task, task.is_settled):
                return False
        self.check_tasks(due, tick)
        if not self.resume_cycles(tick):
            return False
        order = self._last_first
        slowest = None
        for task in order:
            if task.deadline > end:
                continue
            if task.is_finished(end):
                # The task has already posted its report. Consume the post, because the semaphore
                # would eventually overflow.
                task.done.try_acquire()
            else:
                slowest = task
                if not self.await_state(task, lambda task=task: task.is_finished(end)):  # type: ignore[misc]
                    return False
        if slowest is not None and slowest is not order[0]:
            order.remove(slowest)
            order.insert(0, slowest)
        return True

    def resume_cycles(self, tick: int) -> bool:
        """Continue each cycle that takes simulated time until `tick`, and wait for its end.

        Returns:
            False if the launcher has ended or the host requests the end of the run.
        """
        return all(
            self.resume_cycle(task) for task in self.tasks if 0 < task.block[Block.FINISH] <= tick
        )

    def resume_cycle(self, task: ReleasedTask) -> bool:
        """Continue the cycle of a waiting task, and wait until it has ended or waits again.

        Its messages may be visible from the next tick, before the task's deadline.

        Returns:
            False if the launcher has ended or the host requests the end of the run.
        """
        done = task.block[Block.DONE]
        task.resume()
        return self.await_state(task, lambda: task.block[Block.DONE] != done or task.is_settled())

    def wait_until_settled(self) -> None:
        """Wait until every task has finished its last release, including plans."""
        for task in self.tasks:
            self.await_state(task, task.is_settled)

    def await_state(self, task: ReleasedTask, condition: Callable[[], bool]) -> bool:
        """Wait until a condition on the state of a task is true.

        Args:
            task: Task on whose state the condition depends.
            condition: Function that evaluates the condition, called after each report of the task.

        Returns:
            False if the launcher has ended or the host requests the end of the run.
        """
        wait = task.done.wait
        while not condition():
            # The deadline may have been set for an earlier wait. A timeout that comes too early
            # only costs one extra check.
            if wait() and not self._check_after_timeout(task):
                return False
        return True

    def _check_after_timeout(self, task: ReleasedTask) -> bool:
        """After a wait without a report, decide whether to wait longer, and update `is_stopped`.

        Returns:
            False if the launcher has ended or the host requests the end of the run.
        """
        if not self._segment.launcher_is_alive or self.words[System.STOP_REQUEST]:
            return False
        # Lockstep does not wait for a process that has been stopped by a signal.
        task.check_stopped()
        task.done.set_deadline(time.monotonic_ns() + CHECK_NS)
        return True

    def _wait_for_follower(self, tick: int) -> bool:
        """Wait for the recorder if its rings would otherwise overflow in `tick`.

        The wait has no time limit, because no simulated time passes. If the recorder is stopped or
        dead, however, the clock stops waiting for it after `MAX_RECORDER_WAIT_S`.

        Returns:
            False if the host requests the end of the run or the launcher has ended.
        """
        words = self.words
        since = time.monotonic()
        while (pid := words[System.FOLLOWER_PID]) and self._is_recorder_behind(tick):
            if read_state(pid) not in (*STOPPED_STATES, *ENDED_STATES):
                since = time.monotonic()
            elif time.monotonic() - since > MAX_RECORDER_WAIT_S:
                words[System.FOLLOWER_PID] = 0
            if words[System.STOP_REQUEST] or not self._segment.launcher_is_alive:
                return False
            time.sleep(POLL_S)
        return True

    def _is_recorder_behind(self, tick: int) -> bool:
        """Check whether the rings would overflow if `tick` began before the recorder catches up.

        While a mailbox is flooded, its ring can hold the messages of little more than one tick.
        """
        if self.is_flooded and self.words[System.FOLLOWER_DRAINED] < tick - 1:
            return True
        return self.words[System.FOLLOWER_TICK] < tick - self._history_ticks

    def _wait_for_step(self, tick: int) -> bool:
        """While the host single-steps the rack, wait before `tick` until the host permits it.

        Returns:
            False if the launcher has ended.
        """
        words = self.words
        if not 0 < words[System.HOLD_AT] <= tick + 1:
            return True
        self.wait_until_settled()
        words[System.HELD] = tick + 1
        self.alarms.wake_rack()
        wait_s = POLL_S
        while 0 < words[System.HOLD_AT] <= tick + 1 and not words[System.STOP_REQUEST]:
            if not self._segment.launcher_is_alive:
                return False
            time.sleep(wait_s)
            wait_s = min(2.0 * wait_s, MAX_POLL_S)
        words[System.HELD] = 0
        return True

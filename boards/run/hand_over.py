"""The clock's part in hand-overs: it asks a standby to take over from a copy that is lost.

In lockstep the clock decides between two ticks, when every task has finished. The digest of a run
therefore does not depend on the moment at which a process died. In real time a standby takes over
by itself if it finds the active copy late or stopped: see `rack.boards.run.replica`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rack.backplane.clock.driver import ClockDriver
from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block, HandOver, System


class Copies(NamedTuple):
    """The copies of one task, in their order."""

    words: memoryview  # control block of the first copy, with the words of the hand-over
    tasks: Sequence[ReleasedTask]

    @property
    def active(self) -> ReleasedTask:
        """The active copy."""
        return self.tasks[self.words[Block.ACTIVE] % len(self.tasks)]


class HandOverDirector:
    """Requests hand-overs at the beginning of a tick, before any task is released."""

    def __init__(self, segment: Segment, driver: ClockDriver) -> None:
        self._driver = driver
        self._is_lockstep = bool(segment.words[System.LOCKSTEP])
        tasks = {task.spec.name: task for task in driver.tasks}
        layout = segment.layout
        self._groups = {
            board: Copies(
                segment.get_block(board), [tasks[copy.name] for copy in layout.list_copies(board)]
            )
            for board in layout.replicated_tasks
        }

    def check_active_copies(self) -> None:
        """Request a hand-over from each active copy that is lost or, in lockstep, has stopped."""
        for group in self._groups.values():
            if stray := group.words[Block.STRAYED]:
                group.words[Block.STRAYED] = 0
                self._take_out(group, group.tasks[(stray - 1) % len(group.tasks)])
            if reason := self._find_reason(group.active):
                self._hand_over(group, reason)

    def _take_out(self, group: Copies, stray: ReleasedTask) -> None:
        """Mark a copy that has strayed as lost. The Rack then kills its process and restarts it."""
        if stray.is_lost or (
            stray is group.active and not self._hand_over(group, HandOver.STRAYED)
        ):
            return
        tick = self._driver.words[System.TICK]
        stray.mark_lost(tick)
        self._driver.watchdog.losses += 1
        self._driver.alarms.raise_alarm(tick, Alarm.STRAYED, stray.index)

    def _find_reason(self, active: ReleasedTask) -> HandOver:
        """Return why a copy must be replaced, or NONE."""
        if active.is_lost:
            return HandOver.LOST
        if not self._is_lockstep:
            return HandOver.NONE
        if active.is_stopped:
            return HandOver.STOPPED
        is_due = active.deadline <= self._driver.words[System.TICK]
        return HandOver.LATE if is_due and not _is_done(active) else HandOver.NONE

    def _hand_over(self, group: Copies, reason: HandOver) -> bool:
        """Request a hand-over to a standby. In lockstep, wait until it is done.

        Args:
            group: Copies of the task.
            reason: Reason for the hand-over. For an operator, only a copy that has the state of the
                active one can take over.

        Returns:
            False if no standby can take over.
        """
        able = [
            task
            for task in group.tasks
            if task is not group.active
            and not (task.is_lost or task.is_stopped)
            and (_is_done(task) or not self._is_lockstep)
            and (task.block[Block.ALIGNED] or reason != HandOver.COMMANDED)
        ]
        if not able:
            return False
        # Of equal ones, this takes the first.
        best = max(able, key=lambda task: task.block[Block.ALIGNED] > 0)
        words = group.words
        words[Block.TAKE_OVER_REASON] = reason
        words[Block.TAKE_OVER] = group.tasks.index(best) + 1
        best.wake()
        self._driver.await_state(best, lambda: not words[Block.TAKE_OVER] or best.is_lost)
        return True

    def switch_copy(self, board: str) -> None:
        """Request a hand-over for an operator, if a standby has the state of the active copy."""
        group = self._groups.get(board)
        if group is not None and not self._hand_over(group, HandOver.COMMANDED):
            self._driver.alarms.raise_alarm(
                self._driver.words[System.TICK], Alarm.NOT_SWITCHED, group.active.index
            )

    def is_served(self, task: ReleasedTask) -> bool:
        """Return True if another copy does the work of a lost task."""
        group = self._groups.get(task.spec.board)
        return group is not None and task in group.tasks and not group.active.is_lost


def _is_done(task: ReleasedTask) -> bool:
    """Return True if a task has finished its last release."""
    return bool(task.block[Block.DONE] == task.block[Block.RELEASED])

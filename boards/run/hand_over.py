"""The clock's part in hand-overs: it asks a standby to take over from a copy that is lost.

In lockstep the clock decides between two ticks, when every task has finished. The digest of a run
therefore does not depend on the moment at which a process died. In real time a standby takes over
by itself if it finds the active copy late or stopped: see `rack.boards.run.replica`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rack.backplane.clock.driver import ClockDriver
from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block, HandOver, System


@dataclass(frozen=True)
class Copies:
    """The copies of one task.

    Attributes:
        words: Words of the hand-over, in the control block of the first copy.
        tasks: The copies in their order.
    """

    words: memoryview
    tasks: Sequence[ReleasedTask]

    @property
    def active(self) -> ReleasedTask:
        """The active copy."""
        return self.tasks[self.words[Block.ACTIVE] % len(self.tasks)]


class HandOverDirector:
    """Requests hand-overs at the beginning of a tick, before any task is released.

    Attributes:
        groups: Tasks with standbys.
    """

    def __init__(self, segment: Segment, driver: ClockDriver) -> None:
        self._driver = driver
        self._is_lockstep = bool(segment.words[System.LOCKSTEP])
        tasks = {task.spec.name: task for task in driver.tasks}
        self.groups = [
            Copies(
                segment.get_block(board),
                [tasks[copy.name] for copy in segment.layout.list_copies(board)],
            )
            for board in segment.layout.replicated
        ]

    def check_active_copies(self) -> None:
        """Request a hand-over from each active copy that is lost or, in lockstep, has stopped."""
        for group in self.groups:
            if stray := group.words[Block.STRAYED]:
                group.words[Block.STRAYED] = 0
                self._take_out(group, group.tasks[(stray - 1) % len(group.tasks)])
            active = group.active
            if reason := self._find_reason(active):
                self.hand_over(group, reason)

    def _take_out(self, group: Copies, stray: ReleasedTask) -> None:
        """Mark a copy that has strayed as lost. The Rack then kills its process and restarts it."""
        if stray.is_lost or (stray is group.active and not self.hand_over(group, HandOver.STRAYED)):
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
        is_late = active.block[Block.DONE] != active.block[Block.RELEASED]
        return (
            HandOver.LATE
            if is_late and active.deadline <= self._driver.words[System.TICK]
            else HandOver.NONE
        )

    def hand_over(self, group: Copies, reason: HandOver) -> bool:
        """Request a hand-over to a standby. In lockstep, wait until it is done.

        Args:
            group: Copies of the task.
            reason: Reason for the hand-over.

        Returns:
            False if no standby can take over.
        """
        standbys = [task for task in group.tasks if task is not group.active]
        able = [task for task in standbys if self._is_able(task)]
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
        for group in self.groups:
            aligned = [task for task in group.tasks if task.block[Block.ALIGNED] > 0]
            if group.tasks[0].spec.name == board and any(map(self._is_able, aligned)):
                self.hand_over(group, HandOver.COMMANDED)

    def _is_able(self, task: ReleasedTask) -> bool:
        """Return True if a copy can take over: it runs and, in lockstep, is not late."""
        block = task.block
        is_done = block[Block.DONE] == block[Block.RELEASED] or not self._is_lockstep
        return not task.is_lost and not task.is_stopped and is_done

    def is_served(self, task: ReleasedTask) -> bool:
        """Return True if another copy does the work of a lost task."""
        return any(task in group.tasks and not group.active.is_lost for group in self.groups)

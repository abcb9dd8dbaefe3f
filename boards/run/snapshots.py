"""Snapshots of a rack in lockstep, taken between two ticks when every task has finished.

Each task and the clock fork a copy of themselves, and the clock copies the segment. The tasks fork
at the same time, each on its core. A snapshot that is due while a board is lost is taken after the
board has rejoined, because a missing process cannot be copied.
"""

from __future__ import annotations

import os
import sys
import time
from functools import partial

from rack.backplane.byte_lock import ProcessLock
from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.copies import copy_memory
from rack.backplane.process import write_line
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System, TaskState
from rack.boards.errors import NO_SNAPSHOTS_PREFIX, SnapshotError
from rack.boards.run.attributes import read_attributes
from rack.boards.run.copying import Copier
from rack.boards.run.settings import change_settings
from rack.boards.run.task import Task

FIRST_COST_S = 0.05
"""Time for which a snapshot is assumed to stop the rack, before the first one is measured."""
LOOK_TICKS = 50
"""Number of ticks between two checks whether enough time has passed for a snapshot."""
COPY_REFUSED = -1
"""Value of `Block.COPY` by which a task reports that it cannot be copied."""


def has_snapshots_enabled(segment: Segment) -> bool:
    """Return True if snapshots are enabled for the rack."""
    enabling = System.SNAPSHOT_PART, System.SNAPSHOT_EVERY, System.SNAPSHOT_AT
    return any(segment.words[word] for word in enabling)


def copy_task(task: Task, copier: Copier, attention: int) -> None:
    """Fork a copy of a task between two of its cycles, when the clock requests one.

    The clock is told that the copy exists, or that the task cannot be copied. In the copy, this
    returns when a rack continues from it.

    Args:
        task: The task.
        copier: Forks copies of its process.
        attention: Event descriptor that wakes the Rack.
    """
    block = task.block
    try:
        request = copier.fork_copy(block[Block.COPY] - 1, show=partial(read_attributes, task.level))
    except SnapshotError as error:
        write_line(sys.stderr, f"{NO_SNAPSHOTS_PREFIX}{error}")
        block[Block.COPY] = COPY_REFUSED
    else:
        if request is not None:
            if request.context is not None:
                change_settings(task.level, request.context)
            block[Block.PID] = os.getpid()
            block[Block.STATE] = TaskState.RUNNING
            task.stopwatch.start_counting()
            os.eventfd_write(attention, 1)
        block[Block.COPY] = 0
    task.stopwatch.notify_clock()


class ClockCopies:
    """Takes the snapshots of a rack.

    Snapshots are taken as often as possible without stopping the rack for more than 1 /
    `System.SNAPSHOT_PART` of the time. Additional snapshots are taken every `System.SNAPSHOT_EVERY`
    ticks, and before the tick in `System.SNAPSHOT_AT`.

    Attributes:
        cost_s: Time for which the last snapshot stopped the rack.
    """

    def __init__(self, segment: Segment, driver: LockstepDriver, copier: Copier) -> None:
        self.cost_s = FIRST_COST_S
        self._segment = segment
        self._driver = driver
        self._copier = copier
        part = segment.words[System.SNAPSHOT_PART]
        self._not_before_s = time.monotonic() + FIRST_COST_S * part
        self._taken_at = -sys.maxsize
        self._is_refused = False

    def __call__(self, tick: int) -> int:
        """Take a snapshot before `tick`, if one is due and no task is lost or stopped.

        Returns:
            The next tick before which a snapshot may be due.
        """
        if self._is_refused:
            return sys.maxsize
        words = self._segment.words
        requested_tick = words[System.SNAPSHOT_AT] - 1
        part, every = words[System.SNAPSHOT_PART], words[System.SNAPSHOT_EVERY]
        is_due = (every > 0 and tick >= self._taken_at + every) or (
            part > 0 and time.monotonic() >= self._not_before_s
        )
        if tick == requested_tick or is_due:
            tasks = self._driver.tasks
            self._driver.wait_until_settled()
            are_there = [task.is_settled() and not task.is_lost | task.is_stopped for task in tasks]
            if all(are_there) and self._take_snapshot(tick):
                # This process is a copy from which a rack continues. Apply that rack's policy.
                return self(tick)
        next_ticks = [requested_tick] if requested_tick > tick else []
        if every:
            next_ticks.append(max(self._taken_at + every, tick + 1))
        if part:
            next_ticks.append(tick + LOOK_TICKS)
        return min(next_ticks, default=sys.maxsize)

    def _take_snapshot(self, tick: int) -> bool:
        """Take a snapshot before `tick`. If a task cannot be copied, take no further snapshots.

        Returns:
            False in this process. True in a copy of it, once a rack continues from the snapshot.
        """
        started_s = time.monotonic()
        tasks = self._driver.tasks
        for task in tasks:
            task.block[Block.COPY] = tick + 1
            task.wake()
        for task in tasks:
            self._driver.await_state(task, partial(_is_copied, task.block))
        if any(task.block[Block.COPY] for task in tasks):
            # A task that cannot be copied now could not be copied later either. Stop trying.
            for task in tasks:
                task.block[Block.COPY] = 0
            self._is_refused = True
            return False
        self._taken_at = tick
        memory = copy_memory(self._segment)
        goes_on = False
        try:
            goes_on = self._copier.fork_copy(tick, memory) is not None
        except SnapshotError as error:
            write_line(sys.stderr, f"{NO_SNAPSHOTS_PREFIX}{error}")
        os.close(memory)
        words = self._segment.words
        now_s = time.monotonic()
        if goes_on:
            # A fork does not inherit the lock of the clock, without which a standby would run too.
            ProcessLock(self._segment.fd, 8 * System.CLOCK_PID).take()
            words[System.CLOCK_PID] = os.getpid()
            words[System.EPOCH_NS] = time.monotonic_ns()
            words[System.STATE] = Run.RUNNING
        else:
            self.cost_s = now_s - started_s
        self._not_before_s = now_s + self.cost_s * words[System.SNAPSHOT_PART]
        return goes_on


def _is_copied(block: memoryview) -> bool:
    """Check whether a task has forked its copy, or has reported that it cannot be copied.

    Args:
        block: Control block of the task.
    """
    return block[Block.COPY] <= 0

"""Waiting for the next cycle: `waituntil(next-cycle)` of the paper's pseudo-code.

A board blocks on its semaphore ("signal"), or busy-waits on the tick ("poll") where a context switch is
too large a part of its cycle and it has a core of its own.
"""

from __future__ import annotations

import os

import posix_ipc

from backplane.clock import SystemClock
from backplane.process import is_alive
from backplane.segment import Segment
from backplane.semaphores import wake_semaphore
from backplane.words import Block, Head

CHECK_S = 0.25
"""A wait that takes longer looks whether the launcher still lives."""


class NextCycle:
    """The releases of one task, on the grid. A late task skips the releases that passed, and counts them."""

    def __init__(self, segment: Segment, task: str, poll: bool = False) -> None:
        self._spec = segment.layout.task(task)
        self._clock = SystemClock(segment)
        self._block = segment.block(task)
        self._semaphore = wake_semaphore(segment.rack, task)
        self._launcher = segment.words[Head.LAUNCHER_PID], segment.words[Head.LAUNCHER_START]
        self._poll = poll
        self._last = self._block[Block.RELEASED]
        self._not_before = 0
        self.skipped = 0

    def wait(self) -> int | None:
        """Wait for the next release and return its tick; None when the run is over.

        Sets `skipped` to the releases that passed since the last one.
        """
        every = self._spec.every
        while not self._clock.is_stopped:
            tick = self._clock.tick
            release = tick - tick % every
            if release > self._last and release >= self._not_before and self._clock.is_running:
                self.skipped = self._count_skipped(release)
                self._last = release
                return release
            if not (self._spin() if self._poll else self._block_on_semaphore()):
                return None
        return None

    def _count_skipped(self, release: int) -> int:
        expected = max(self._last + 1, self._not_before)
        expected += -expected % self._spec.every
        return (release - expected) // self._spec.every

    def _block_on_semaphore(self) -> bool:
        try:
            self._semaphore.acquire(CHECK_S)
        except posix_ipc.BusyError:
            return is_alive(*self._launcher)
        return True

    def _spin(self) -> bool:
        tick = self._clock.tick
        for _ in range(100_000):
            if self._clock.tick != tick or self._clock.is_stopped:
                return True
        os.sched_yield()
        return is_alive(*self._launcher)

    def hold_until(self, tick: int) -> None:
        """Take no release before `tick`: a planner that works on a plan keeps its time slice."""
        self._not_before = tick

"""The Rack's check for hanging processes: those that make no progress for much longer than their
period.

In real time it checks the clock alone, since the clock's watchdog checks the tasks. In lockstep it
checks all.
"""

from __future__ import annotations

import time

from rack.backplane.address_map import CLOCK
from rack.backplane.process import GONE, STOPPED, WAITING, state_of
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System

HEARTBEATS_MISSED = 4
"""Cycles without progress that count as hanging: three gave one false alarm in 24,000 at 400 Hz."""
LEAST_S = 2.0
"""Smallest bound: the launcher is an ordinary process among real-time ones and may itself be
late."""
LOCKSTEP_S = 60.0
"""Bound in lockstep, where time stands still during planning."""


class Heartbeat:
    """Checks the clock and, in lockstep, the control blocks of all tasks."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        watched = segment.layout.tasks if self._words[System.LOCKSTEP] else ()
        self._blocks = {task.name: segment.block(task.name) for task in watched}
        bound_s = max(LEAST_S, HEARTBEATS_MISSED * self._words[System.PERIOD_NS] * 1e-9)
        self._bounds = {
            **dict.fromkeys(self._blocks, LOCKSTEP_S),
            CLOCK: LOCKSTEP_S if watched else bound_s,
        }
        self._seen = {name: (-1, time.monotonic()) for name in self._bounds}
        self._reported: set[str] = set()
        self._waited_at = -1

    def hanging(self) -> list[str]:
        """Return the tasks newly found hanging; "clock" is the system clock."""
        if self._words[System.STATE] != Run.RUNNING:
            return []
        now = time.monotonic()
        progress = {}
        for name, block in self._blocks.items():
            done = block[Block.DONE]
            # An idle task, whose newest release is done, is alive; a lost one is already known. One
            # may wait for as long as another rack wants.
            is_idle = done == block[Block.RELEASED] or block[Block.LOST] or block[Block.AWAITS]
            progress[name] = done, is_idle
        blocks = self._blocks.values()
        awaits = any(block[Block.AWAITS] for block in blocks)
        # In lockstep several cycles may be one tick of the clock: it runs while they do.
        ticks = self._words[System.TICK] + sum(block[Block.DONE] for block in blocks)
        progress[CLOCK] = ticks, self._words[System.HELD] or awaits
        found = []
        for name, (count, is_excused) in progress.items():
            seen, since = self._seen[name]
            if count != seen or is_excused:
                self._seen[name] = count, now
                self._reported.discard(name)
            elif (
                now - since > self._bounds[name]
                and name not in self._reported
                and (name != CLOCK or self._clock_is_stuck())
            ):
                found.append(name)
        self._reported.update(found)
        return found

    def _clock_is_stuck(self) -> bool:
        """Say whether a silent clock is stopped, dead or waiting; one that is runnable is merely
        starved.
        """
        state = state_of(self._words[System.CLOCK_PID])
        tick = self._seen[CLOCK][0]
        # Must be seen twice: after a pause of the whole machine the clock is about to be woken.
        waits = state in WAITING
        is_stuck = state in STOPPED + GONE or (waits and self._waited_at == tick)
        self._waited_at = tick if waits else -1
        return is_stuck

"""Signs of life, as the host sees them: a task that has finished nothing for much longer than it may hangs.

In real time the clock's watchdog looks after the tasks; here it is the clock alone. In lockstep, all of them.
"""

from __future__ import annotations

import time

from rack.backplane.address_map import CLOCK
from rack.backplane.process import GONE, STOPPED, WAITING, state_of
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System

HEARTBEATS_MISSED = 4
"""Cycles without a sign of life: three gave a false trip in 24,000 at 400 Hz."""
LEAST_S = 2.0
"""The launcher itself is an ordinary process on a machine full of real-time ones: it looks no closer than this."""
LOCKSTEP_S = 60.0
"""In lockstep a plan takes as long as it takes; time stands still meanwhile."""


class Heartbeat:
    """Watches the control blocks of all tasks, and the clock: without it nothing is ever due."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        watched = segment.layout.tasks if self._words[System.LOCKSTEP] else ()
        self._blocks = {task.name: segment.block(task.name) for task in watched}
        bound_s = max(LEAST_S, HEARTBEATS_MISSED * self._words[System.PERIOD_NS] * 1e-9)
        self._bounds = {**dict.fromkeys(self._blocks, LOCKSTEP_S), CLOCK: LOCKSTEP_S if watched else bound_s}
        self._seen = {name: (-1, time.monotonic()) for name in self._bounds}
        self._reported: set[str] = set()
        self._waited_at = -1

    def hanging(self) -> list[str]:
        """Return the tasks that have come to hang since the last call; "clock" is the system clock."""
        if self._words[System.STATE] != Run.RUNNING:
            return []
        now = time.monotonic()
        for name, block in self._blocks.items():
            # A task that has nothing to do is alive: its newest release is finished. One that is lost is known to be.
            idle = block[Block.DONE] == block[Block.RELEASED] or block[Block.LOST]
            if block[Block.DONE] != self._seen[name][0] or idle:
                self._seen[name] = block[Block.DONE], now
                self._reported.discard(name)
        if self._words[System.TICK] != self._seen[CLOCK][0]:
            self._seen[CLOCK] = self._words[System.TICK], now
            self._reported.discard(CLOCK)
        late = [n for n, (_, at) in self._seen.items() if now - at > self._bounds[n] and n not in self._reported]
        found = [name for name in late if name != CLOCK or self._clock_is_stuck()]
        self._reported.update(found)
        return found

    def _clock_is_stuck(self) -> bool:
        """Say whether a silent clock has stopped, is dead, or waits; one that could run is only starved."""
        state, tick = state_of(self._words[System.CLOCK_PID]), self._seen[CLOCK][0]
        # Seen twice: after a pause of the whole machine it is about to be woken.
        waits = state in WAITING
        is_stuck = state in STOPPED + GONE or (waits and self._waited_at == tick)
        self._waited_at = tick if waits else -1
        return is_stuck

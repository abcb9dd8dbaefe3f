"""Detection of hanging processes by the Rack: no progress for much longer than their period.

In real time only the clock is checked, because the watchdog in the clock's board checks the tasks.
In lockstep the clock and all tasks are checked.
"""

from __future__ import annotations

import time

from rack.backplane.address_map import CLOCK
from rack.backplane.process import ENDED_STATES, STOPPED_STATES, WAITING_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System

HEARTBEATS_MISSED = 4
"""Number of tick periods without progress after which the clock is reported as hanging.

Three ticks gave a false alarm in 24,000 ticks.
"""
LEAST_S = 2.0
"""Shortest time limit. The launcher has no real-time priority and may itself be late."""
LOCKSTEP_S = 60.0
"""Time limit in lockstep, where simulated time stands still during planning."""


class Heartbeat:
    """Checks the progress of the clock and, in lockstep, of all tasks."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        watched = segment.layout.tasks if self._words[System.LOCKSTEP] else ()
        self._blocks = {task.name: segment.get_block(task.name) for task in watched}
        bound_s = max(LEAST_S, HEARTBEATS_MISSED * self._words[System.PERIOD_NS] * 1e-9)
        self._bounds = {
            **dict.fromkeys(self._blocks, LOCKSTEP_S),
            CLOCK: LOCKSTEP_S if watched else bound_s,
        }
        self._seen = {name: (-1, time.monotonic()) for name in self._bounds}
        self._reported: set[str] = set()
        self._waited_at = -1

    def find_hanging(self) -> list[str]:
        """Return the tasks that hang, with the clock as "clock".

        A task that hangs is returned only once, until it makes progress again.
        """
        if self._words[System.STATE] != Run.RUNNING:
            return []
        now = time.monotonic()
        progress = {}
        for name, block in self._blocks.items():
            done = block[Block.DONE]
            # A task need not make progress if its newest release is done, if it is known to be
            # lost, or if it waits for another rack, which may take any time.
            is_idle = done == block[Block.RELEASED] or block[Block.LOST] or block[Block.AWAITS]
            progress[name] = done, is_idle
        blocks = self._blocks.values()
        awaits = any(block[Block.AWAITS] for block in blocks)
        # In lockstep a tick of the clock may contain several cycles, which also count as progress.
        ticks = self._words[System.TICK] + sum(block[Block.DONE] for block in blocks)
        progress[CLOCK] = ticks, self._words[System.HELD] or awaits
        hanging = []
        for name, (count, is_excused) in progress.items():
            seen, since = self._seen[name]
            if count != seen or is_excused:
                self._seen[name] = count, now
                self._reported.discard(name)
            elif (
                now - since > self._bounds[name]
                and name not in self._reported
                and (name != CLOCK or self._is_clock_stuck())
            ):
                hanging.append(name)
        self._reported.update(hanging)
        return hanging

    def _is_clock_stuck(self) -> bool:
        """Return True if the clock's process is stopped or dead, or still waits at the same tick.

        A process that is runnable only lacks processor time and is not stuck.
        """
        state = read_state(self._words[System.CLOCK_PID])
        tick = self._seen[CLOCK][0]
        # The clock must be found waiting twice at the same tick, because after a pause of the whole
        # machine it wakes up soon.
        waits = state in WAITING_STATES
        is_stuck = state in STOPPED_STATES + ENDED_STATES or (waits and self._waited_at == tick)
        self._waited_at = tick if waits else -1
        return is_stuck

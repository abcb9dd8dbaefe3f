"""Detection of hanging processes by the Rack: no progress for much longer than their period.

In real time only the clock is checked, because the watchdog in the clock's board checks the tasks.
In lockstep the clock and all tasks are checked. There a task may compute for any time on a busy
machine, so the limit for a task that computes applies to its processor time.
"""

from __future__ import annotations

import time

from rack.backplane.address_map import CLOCK
from rack.backplane.process import (
    ENDED_STATES,
    STOPPED_STATES,
    WAITING_STATES,
    read_processor_ns,
    read_state,
)
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
COMPUTING_S = 1.0
"""Time without progress after which the processor time of a task is counted."""


class Heartbeat:
    """Checks the progress of the clock and, in lockstep, of all tasks."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        watched = segment.layout.tasks if self._words[System.LOCKSTEP] else ()
        self._blocks = {task.name: segment.get_block(task.name) for task in watched}
        heartbeats_s = HEARTBEATS_MISSED * self._words[System.PERIOD_NS] * 1e-9
        self._bound_s = LOCKSTEP_S if watched else max(LEAST_S, heartbeats_s)
        self._seen = {name: (-1, time.monotonic()) for name in (*self._blocks, CLOCK)}
        self._reported: set[str] = set()
        # Processor time of each task when its count began, in ns.
        self._used_ns: dict[str, int] = {}
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
        # The clock waits for tasks that have a release. If such a task hangs, it is found itself.
        awaits = not all(is_idle for _, is_idle in progress.values()) or any(
            block[Block.AWAITS] for block in blocks
        )
        # In lockstep a tick of the clock may contain several cycles, which also count as progress.
        ticks = self._words[System.TICK] + sum(block[Block.DONE] for block in blocks)
        progress[CLOCK] = ticks, self._words[System.HELD] or awaits
        hanging = []
        for name, (count, is_excused) in progress.items():
            seen, since = self._seen[name]
            if count != seen or is_excused:
                self._seen[name] = count, now
                self._reported.discard(name)
                self._used_ns.pop(name, None)
            elif name not in self._reported and self._is_hanging(name, now - since):
                hanging.append(name)
        self._reported.update(hanging)
        return hanging

    def _is_hanging(self, name: str, silent_s: float) -> bool:
        """Return True if a process that has made no progress for `silent_s` is hanging."""
        if name == CLOCK:
            return silent_s > self._bound_s and self._is_clock_stuck()
        if silent_s < COMPUTING_S:
            return False
        pid = self._blocks[name][Block.PID]
        used_ns = read_processor_ns(pid)
        used_ns -= self._used_ns.setdefault(name, used_ns)
        is_computing = read_state(pid) not in WAITING_STATES + STOPPED_STATES + ENDED_STATES
        return (used_ns * 1e-9 if is_computing else silent_s) > self._bound_s

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

"""Faults of a task's own computing time: an executor that overruns, a planner that is slow."""

from __future__ import annotations

import random
from time import monotonic_ns

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import Entry, FaultEntry
from rack.backplane.layout import TaskSpec


class Load:
    """Work beyond a task's own, done behind it."""

    def __init__(self, entry: FaultEntry, spec: TaskSpec, clock: SystemClock) -> None:
        self._entry, self._spec, self._clock = entry, spec, clock
        cycles, is_random, *_ = entry.parameters
        self._cycles, self._is_random = cycles, bool(is_random)

    def burn(self, tick: int) -> None:
        """Compute until an executor has taken that many cycles more, or a planner is that far beyond its slice."""
        now = monotonic_ns()
        self._entry.acted(tick, now)
        cycle_ns = self._spec.every * self._clock.period_ns
        part = random.Random(self._entry[Entry.SEED] + tick).random() if self._is_random else 1.0
        more_ns = int(part * self._cycles * cycle_ns)
        is_planner = self._spec.role == "planner"
        slice_end = self._clock.time_of(tick + self._spec.every * self._spec.within_cycles)
        end = max(now, slice_end) + more_ns if is_planner else now + more_ns
        while monotonic_ns() < end:
            pass

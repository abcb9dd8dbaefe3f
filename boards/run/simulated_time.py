"""Computing that takes simulated time, in lockstep.

In lockstep the clock waits for every cycle, so a cycle takes no simulated time unless something
adds to it: a load fault, an interrupt handler, or the schedule of a simulated core. Each of these
adds a step:

    task.simulated.steps.append(lambda tick, begin_ns, end_ns: end_ns + 300_000)

The steps of a cycle run after the level has computed, in their order. Each gets the end from the
step before and returns a later one, or the same. The cycle then waits for the tick of its end
before it writes, if that tick is not before its deadline or if readers see a message as soon as it
is written. A cycle cannot begin before the end of the one before it.

All times are simulated ns since tick 0. A tick is as long as in real time (`System.PERIOD_NS`).
"""

from __future__ import annotations

from collections.abc import Callable

from rack.backplane.layout import TaskSpec
from rack.backplane.segment import Segment
from rack.backplane.words import System

FinishStep = Callable[[int, int, int], int]
"""Computes the end of a cycle from its release tick, its begin, and the end before this step.

It depends on nothing but simulated time, so that runs repeat. Before all steps, the end is the
begin.
"""


class SimulatedTime:
    """Computes the simulated times of one task's cycles.

    Attributes:
        steps: Steps that determine the end of a cycle, in their order.
        clock_ns: Length of a tick.
        late_ns: Time by which the clock is late for the present release.
        begin_ns: Begin of the last cycle.
        end_ns: End of the last cycle.
    """

    def __init__(self, segment: Segment, spec: TaskSpec) -> None:
        self.clock_ns = segment.words[System.PERIOD_NS]
        self.steps: list[FinishStep] = []
        self.late_ns = self.begin_ns = self.end_ns = 0
        self._shows_at_once = not all(
            mailbox.is_repeatable
            for mailbox in segment.layout.mailboxes
            if mailbox.writer == spec.name
        )

    def find_end_tick(self, tick: int, deadline: int) -> int | None:
        """Compute the end of a cycle.

        Args:
            tick: Release tick of the cycle.
            deadline: Tick before which the cycle must end.

        Returns:
            The tick in which the cycle ends if the cycle must wait for it before it writes,
            otherwise None.
        """
        self.begin_ns = end_ns = max(tick * self.clock_ns + self.late_ns, self.end_ns)
        for step in self.steps:
            end_ns = step(tick, self.begin_ns, end_ns)
        self.end_ns = end_ns
        end_tick = end_ns // self.clock_ns
        must_wait = end_tick >= deadline or (self._shows_at_once and end_tick > tick)
        return end_tick if must_wait else None

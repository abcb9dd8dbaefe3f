"""The board in slot 1: the system controller, which runs the clock."""

from __future__ import annotations

import time
from dataclasses import dataclass

from backplane.clock_driver import ClockDriver, Ended, LockstepDriver, RealtimeDriver
from backplane.message import State
from backplane.protocols import open_observer
from backplane.segment import Segment
from backplane.words import System

HEAD_START_NS = 20_000_000
"""From the start of the clock board to tick 0: its own start-up is not a late tick."""


@dataclass(frozen=True)
class ClockWiring:
    """How a run goes in time. `period_ns` is of the wall clock, the speed factor counted in.

    The run ends after `stop_tick` ticks (0: never), or `linger` ticks after the mailbox `ends_run` says
    done or error.
    """

    lockstep: bool
    period_ns: int
    stop_tick: int
    ends_run: str | None
    linger: int
    history: int
    core: int
    priority: int


class EndOfRun:
    """Decides, by ticks alone, where a run ends."""

    def __init__(self, segment: Segment, wiring: ClockWiring) -> None:
        self._stop_tick = wiring.stop_tick or None
        self._linger = wiring.linger
        self._reader = open_observer(segment, wiring.ends_run) if wiring.ends_run else None

    def __call__(self, tick: int) -> int | None:
        """Return the tick at which the run stops; None as long as that is open."""
        if self._stop_tick is None and self._reader is not None:
            reading = self._reader.read(tick)
            if reading.is_new and reading.value.state in (State.DONE, State.ERROR):
                self._stop_tick = tick + self._linger
        return self._stop_tick


def run_clock(segment: Segment, wiring: ClockWiring) -> None:
    """Run the clock until the run is over."""
    segment.words[System.EPOCH_NS] = time.monotonic_ns() + HEAD_START_NS
    driver_of_run(segment, wiring, EndOfRun(segment, wiring)).run()


def driver_of_run(segment: Segment, wiring: ClockWiring, ended: Ended) -> ClockDriver:
    """Return the clock's driver for the run's mode."""
    if not wiring.lockstep:
        return RealtimeDriver(segment, ended)
    at_once = any(mailbox.protocol != "time-slice" for mailbox in segment.layout.mailboxes)
    return LockstepDriver(segment, ended, at_once, wiring.history)

"""The board in slot 1: the system controller, which runs the clock."""

from __future__ import annotations

import os
import time

from rack.backplane.address_map import CLOCK
from rack.backplane.alarms import Alarm, AlarmWriter
from rack.backplane.clock import SystemClock
from rack.backplane.clock_driver import ClockDriver, Ended
from rack.backplane.lockstep_driver import LockstepDriver
from rack.backplane.message import State
from rack.backplane.protocols import open_observer
from rack.backplane.realtime_driver import RealtimeDriver
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System
from rack.boards.system_controller import SystemController
from rack.boards.wiring import ClockWiring

HEAD_START_NS = 20_000_000
"""From the start of the clock board to tick 0: its own start-up is not a late tick."""


class EndOfRun:
    """Decides, by ticks alone, where a run ends."""

    def __init__(self, segment: Segment, wiring: ClockWiring) -> None:
        self._stop_tick = wiring.stop_tick or None
        self._linger = wiring.linger
        self._reader = open_observer(segment, wiring.ends_run) if wiring.ends_run else None
        self._writer = segment.block(self._reader.spec.writer) if self._reader is not None else None
        self._silent = wiring.silent
        self._heard: int | None = None

    def __call__(self, tick: int) -> int | None:
        """Return the tick at which the run stops; None as long as that is open."""
        if self._stop_tick is None and self._reader is not None and self._writer is not None:
            reading = self._reader.read(tick)
            if reading.is_new or self._heard is None or self._writer[Block.LOST]:
                self._heard = tick
            is_over = reading.is_new and reading.value.state in (State.DONE, State.ERROR)
            if is_over or tick - self._heard >= self._silent:
                self._stop_tick = tick + self._linger
        return self._stop_tick


def run_clock(segment: Segment, wiring: ClockWiring, attention: int | None = None) -> None:
    """Run the clock until the run is over; a restarted clock goes on with the grid that it finds."""
    words = segment.words
    words[System.CLOCK_PID] = os.getpid()
    alarms = AlarmWriter(segment, CLOCK, attention)
    if words[System.STATE] != Run.RUNNING:
        words[System.EPOCH_NS] = time.monotonic_ns() + HEAD_START_NS
    else:
        now, newest = SystemClock(segment).now(), words[System.TICK]
        alarms.ring(now, Alarm.REJOINED, value=now - newest, since=newest)
    driver = driver_of_run(segment, wiring, EndOfRun(segment, wiring), alarms)
    driver.controller = SystemController(segment, wiring, driver)
    driver.run()


def driver_of_run(segment: Segment, wiring: ClockWiring, ended: Ended, alarms: AlarmWriter) -> ClockDriver:
    """Return the clock's driver for the run's mode."""
    if not wiring.lockstep:
        return RealtimeDriver(segment, ended, alarms)
    at_once = any(mailbox.protocol != "time-slice" for mailbox in segment.layout.mailboxes)
    return LockstepDriver(segment, ended, at_once, wiring.history, alarms)

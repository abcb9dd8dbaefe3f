"""The clock in real time: ticks on an absolute grid of CLOCK_MONOTONIC."""

from __future__ import annotations

import time
from collections.abc import Callable

from rack.backplane.clock_driver import ClockDriver
from rack.backplane.wake import CHECK_S
from rack.backplane.words import Run, System


class RealtimeDriver(ClockDriver):
    """Ticks on the grid of CLOCK_MONOTONIC. A late clock leaves ticks out and counts them."""

    def run(self) -> None:
        """Give out ticks until the run is over or the launcher is gone."""
        words = self.words
        period, epoch = words[System.PERIOD_NS], words[System.EPOCH_NS]
        beat = max(1, int(CHECK_S * 1e9) // period)
        last = self.first_tick - 1
        # The grid begins a little after the clock: tick 0 has its grid point too.
        tick = self._sleep_until_next(last, epoch, period)
        words[System.STATE] = Run.RUNNING
        while not self.is_over(tick):
            if self.begin(tick):
                self.release(tick, last)
                if tick // beat != last // beat and not self.launcher_is_alive:
                    break
                last = tick
            tick = self._sleep_until_next(tick, epoch, period)
        self.end()

    def settle(self) -> None:
        """Wait for nobody: in real time a task is met wherever it is."""

    def await_state(self, condition: Callable[[], bool]) -> None:
        """Wait for nothing: time does not."""

    def _sleep_until_next(self, tick: int, epoch: int, period: int) -> int:
        """Sleep to the next grid point; return the newest tick of the run that has come by then, or the one after."""
        wait = epoch + (tick + 1) * period - time.monotonic_ns()
        if wait > 0:
            time.sleep(wait * 1e-9)
        now = (time.monotonic_ns() - epoch) // period
        if stop := self.words[System.STOP_TICK]:
            # A late clock gives out the run's last tick all the same: who was to work in it is seen to be late.
            now = min(now, stop - 1)
        # Never early: the wait may end a rounding error before its grid point.
        next_tick = max(tick + 1, now)
        self.words[System.CLOCK_SKIPPED] += next_tick - tick - 1
        return next_tick

"""The grid of this rack next to those of others: ticks as times on another machine's clock, and the
other way round.
"""

from __future__ import annotations

from math import ceil

from rack.backplane.clock.system_clock import SystemClock, ticks_of
from rack.backplane.segment import Segment
from rack.boards.lan.envelope import Envelope
from rack.boards.lan.peers import PeerRack


class OwnGrid:
    """Converts ticks. In lockstep all racks have one simulated time; in real time each has an epoch
    of its own.

    `every`: ticks of the adapter's cycle.
    """

    def __init__(self, segment: Segment, every: int = 1) -> None:
        self._clock = SystemClock(segment)
        self._clock_ns = segment.layout.clock_ns
        self._cycle_ns = every * self._clock_ns
        self.is_lockstep = self._clock.is_lockstep
        self.tick_s = self._clock_ns * 1e-9
        """One tick, s of simulated time."""

    def cycles(self, rate_hz: float) -> int:
        """Return the period, in cycles of the adapter, of an exchange."""
        return ticks_of(rate_hz, self._cycle_ns, "an exchange")

    def ticks_in(self, real_ns: float) -> int:
        """Return the ticks within which that much real time has passed."""
        return ceil(real_ns / self._clock.period_ns)

    def time_ns(self, tick: int) -> int:
        """Return the simulated time of a tick, ns."""
        return tick * self._clock_ns

    def stamp_ns(self, tick: int) -> int:
        """Return the CLOCK_MONOTONIC of a tick on this machine, ns; in lockstep its simulated
        time.
        """
        return self.time_ns(tick) if self.is_lockstep else self._clock.time_of(tick)

    def tick_of(self, head: Envelope, peer: PeerRack, tick: int) -> int:
        """Return the tick here at which a message was written there, at most `tick`, now.

        The clocks have been compared. It counts as written as early as the uncertainty of that
        permits: never as younger than it is.
        """
        if self.is_lockstep:
            return min(tick, head.time_ns // self._clock_ns)
        here_ns = head.stamp_ns - (peer.offset_ns or 0) - peer.uncertainty_ns
        return min(tick, (here_ns - self._clock.time_of(0)) // self._clock.period_ns)

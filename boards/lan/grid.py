"""Conversion between this rack's ticks and the clocks of other racks."""

from __future__ import annotations

from math import ceil

from rack.backplane.clock.system_clock import SystemClock, compute_period_ticks
from rack.backplane.segment import Segment
from rack.boards.lan.envelope import Envelope
from rack.boards.lan.peers import PeerRack


class OwnGrid:
    """Converts ticks of this rack to times and back.

    In lockstep all racks share one simulated time. In real time each rack has its own epoch.

    Args:
        segment: Segment of the rack.
        every: Length of the adapter's cycle in ticks.

    Attributes:
        is_lockstep: Whether the rack runs in lockstep.
        clock_ns: Length of one tick in ns of simulated time.
    """

    def __init__(self, segment: Segment, every: int = 1) -> None:
        self._clock = SystemClock(segment)
        self.clock_ns = segment.layout.clock_ns
        self._cycle_ns = every * self.clock_ns
        self.is_lockstep = self._clock.is_lockstep

    def compute_period_cycles(self, rate_hz: float) -> int:
        """Return the period of an exchange in cycles of the adapter.

        Raises:
            ClockError: The rate does not divide the adapter's rate.
        """
        return compute_period_ticks(rate_hz, self._cycle_ns, "an exchange")

    def ticks_in(self, real_ns: float) -> int:
        """Return the smallest number of ticks that last at least `real_ns` ns of real time."""
        return ceil(real_ns / self._clock.period_ns)

    def time_ns(self, tick: int) -> int:
        """Return the simulated time of a tick in ns."""
        return tick * self.clock_ns

    def stamp_ns(self, tick: int) -> int:
        """Return the CLOCK_MONOTONIC time of a tick in ns. In lockstep, its simulated time."""
        return self.time_ns(tick) if self.is_lockstep else self._clock.compute_time_ns(tick)

    def to_local_ns(self, head: Envelope, peer: PeerRack, age_ns: int = 0) -> int:
        """Convert the time of a message of another rack to simulated time of this rack in ns.

        The uncertainty of the clock offset is subtracted, so that the result is never later than
        the true time.

        Args:
            head: Envelope of the message.
            peer: The rack that wrote it. In real time its clock offset must be known.
            age_ns: Convert the time this long before the message was written.
        """
        if self.is_lockstep:
            return head.time_ns - age_ns
        here_ns = head.stamp_ns - age_ns - (peer.offset_ns or 0) - peer.uncertainty_ns
        real_ns = here_ns - self._clock.compute_time_ns(0)
        return real_ns * self.clock_ns // self._clock.period_ns

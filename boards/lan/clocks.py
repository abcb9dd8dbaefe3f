"""Offsets between the clocks of racks, measured by round trips with four time stamps.

A ping is stamped when it is sent and when it is received; its answer is stamped likewise. The true
offset of the other CLOCK_MONOTONIC is within half the round trip of the measured one, even if the
two directions take different times (the bound of NTP). Arrivals must be stamped at once instead of
in the adapter's next cycle, so a callback in a thread of zenoh stamps them. For the same reason
this callback also answers pings.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from struct import Struct
from threading import Lock
from time import monotonic_ns
from typing import Any, NamedTuple

import numpy as np

from rack.backplane.message import fill_counts
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.lan.envelope import Envelope, Flaw, Sealer, compute_kind
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import parse_sender, ping_key, pong_key
from rack.boards.lan.link import LanLink, ReceivedMessage
from rack.boards.lan.peers import NO_LAUNCH, PeerRack, Peers
from rack.levels.peer import DRIFT_PPM

MAX_ROUND_TRIPS = 32
"""Number of recent round trips among which the best one is used."""
PING_NS = 500_000_000
EAGER_NS = 20_000_000
"""Interval in ns between the first pings to a rack.

After `EAGER_ROUND_TRIPS` answers the interval is `PING_NS`.
"""
EAGER_ROUND_TRIPS = 8
MAX_UNANSWERED = 64
"""Number of recent pings to a rack whose answers are accepted.

A round trip may therefore take more than a second.
"""
ANSWER_NS = 5_000_000
"""Shortest interval in ns between two answers to one rack, as a defence against floods."""
MAX_ASKERS = 1024
"""Maximum number of racks that get answers."""
REPORT_UNKNOWN_NS = 1_000_000_000
"""Time in ns after which an unknown clock offset is reported."""
MAX_UNREAD = 64
"""Maximum number of answers that wait for the next cycle. The oldest is overwritten first."""
_PONG = Struct("<Q4q")
_PING_KIND = compute_kind("ping", 1, np.dtype([]))
_PONG_KIND = compute_kind("pong", 1, np.dtype([("launch", "<u8"), ("stamps", "<i8", 4)]))


class RoundTrip(NamedTuple):
    """Time stamps of a ping and its answer, in ns of CLOCK_MONOTONIC.

    `sent` and `arrived` are taken by this rack; `received` and `answered` by the other one.
    """

    sent: int
    received: int
    answered: int
    arrived: int

    @property
    def duration_ns(self) -> int:
        """Total time in ns that the ping and its answer spent on the network."""
        return (self.arrived - self.sent) - (self.answered - self.received)

    @property
    def offset_ns(self) -> int:
        """Other clock minus this rack's clock in ns, assuming both directions took equally long."""
        return (self.received - self.sent + self.answered - self.arrived) // 2

    def compute_uncertainty_ns(self, now_ns: int) -> int:
        """Return the largest possible error of the offset when this rack's clock shows `now_ns`.

        The error, in ns, grows with the age of the measurement, because the clocks may drift apart.
        """
        # The 1 covers the rounding of two divisions by 2, here and in the offset.
        age_ns = max(0, now_ns - self.sent)
        return self.duration_ns // 2 + 1 + -(-age_ns * DRIFT_PPM // 1_000_000)


class ClockOffset:
    """Offset of another clock, taken from the best of the recent round trips.

    If a round trip contradicts the estimate, all earlier ones are discarded, because one of the
    clocks has stepped, for example while its machine slept.

    Attributes:
        best: Round trip with the smallest uncertainty, or None. All uncertainties grow at
            the same rate, so the choice does not depend on the time.
        steps: Number of steps of either clock that were detected.
    """

    def __init__(self, steps: int = 0) -> None:
        self._recent: deque[RoundTrip] = deque(maxlen=MAX_ROUND_TRIPS)
        self.best: RoundTrip | None = None
        self.steps = steps

    def __len__(self) -> int:
        return len(self._recent)

    def add_round_trip(self, trip: RoundTrip) -> bool:
        """Add a round trip unless its time stamps are impossible. Return True if it was added."""
        if trip.duration_ns < 0 or trip.arrived < trip.sent or trip.answered < trip.received:
            return False
        now_ns = trip.arrived
        best = self.best
        if best is not None:
            difference_ns = abs(trip.offset_ns - best.offset_ns)
            if difference_ns > trip.compute_uncertainty_ns(now_ns) + best.compute_uncertainty_ns(
                now_ns
            ):
                self._recent.clear()
                self.steps += 1
        self._recent.append(trip)
        self.best = min(self._recent, key=lambda recent: recent.compute_uncertainty_ns(now_ns))
        return True


@dataclass
class PeerClock:
    """Clock and grid of one other rack.

    Attributes:
        peer: The rack.
        put: Sends a ping to the rack.
        offset: Offset of the rack's clock.
        sent: Dictionary from the serial of each unanswered ping to the time in ns when it was sent.
        due_ns: Time in ns at which the next ping is due.
        launch_and_losses: Launch and number of losses of the rack when the measurements began.
        epoch_ns: CLOCK_MONOTONIC of the rack's machine at the rack's tick 0, in ns. 0 if the rack
            has not started or has not answered yet.
        period_ns: Real length of the rack's tick in ns.
        clock_ns: Simulated length of the rack's tick in ns.
    """

    peer: PeerRack
    put: Any = None
    offset: ClockOffset = field(default_factory=ClockOffset)
    sent: dict[int, int] = field(default_factory=dict)
    due_ns: int = 0
    launch_and_losses: tuple[int, int] = (NO_LAUNCH, 0)
    epoch_ns: int = 0
    period_ns: int = 1
    clock_ns: int = 0

    def discard_if_outdated(self) -> None:
        """Discard all measurements if the rack has been launched again or lost since they began."""
        launch_and_losses = (self.peer.launch, self.peer.losses)
        if launch_and_losses != self.launch_and_losses:
            self.launch_and_losses = launch_and_losses
            self.due_ns = 0
            self.epoch_ns = 0
            self.clock_ns = 0
            self.offset = ClockOffset(self.offset.steps)
            self.sent.clear()


class Clocks:
    """Measures the clock offsets of all peers. Does nothing in lockstep, where time is shared.

    Pings of other racks are answered from zenoh's threads, at a bounded rate for each rack.

    Attributes:
        taken: Number of answers accepted.
        answered: Number of pings answered.
        withheld: Number of pings not answered because of the rate limit.
        refused: Number of malformed or unexpected pings and answers.
    """

    def __init__(self, segment: Segment, peers: Peers, launch: int, grid: OwnGrid) -> None:
        self._segment = segment
        self._rack = segment.rack
        self._launch = launch
        self._grid = grid
        self._clocks = {peer.rack: PeerClock(peer) for peer in peers}
        self._arrived: deque[tuple[int, ReceivedMessage]] = deque(maxlen=MAX_UNREAD)
        self.taken = self.answered = self.withheld = self.refused = 0
        self._put: dict[str, Any] = {}
        self._again: dict[str, int] = {}
        # Each link of the network calls back from a separate thread.
        self._lock = Lock()
        # Start above every serial that this adapter may have used before a restart.
        self._serial = monotonic_ns()
        self._now_ns = 0

    def open(self, link: LanLink, sealer: Sealer) -> None:
        """Start to answer pings, and prepare to send pings. Do nothing in lockstep."""
        if self._grid.is_lockstep:
            return
        self._link = link
        self._sealer = sealer
        link.call_on_arrival(ping_key("*", self._rack), self._answer_ping)
        # Appending a tuple to a deque is atomic, so no lock is needed.
        link.call_on_arrival(
            pong_key("*", self._rack), lambda pong: self._arrived.append((monotonic_ns(), pong))
        )
        for rack, clock in self._clocks.items():
            clock.put = link.publish(ping_key(self._rack, rack))

    def _answer_ping(self, ping: ReceivedMessage) -> None:
        """Answer a ping, unless it is malformed or exceeds the rate limit.

        Called in a thread of zenoh.
        """
        received = monotonic_ns()
        asker = parse_sender(ping.key)
        with self._lock:
            next_ns = self._again.get(asker)
            if received < (next_ns or 0) or (next_ns is None and len(self._again) == MAX_ASKERS):
                self.withheld += 1
                return
            head = self._sealer.open_message(*ping)
            if isinstance(head, Flaw) or head.kind != _PING_KIND:
                self.refused += 1
                return
            self._again[asker] = received + ANSWER_NS
            self.answered += 1
            key = pong_key(self._rack, asker)
            if asker not in self._put:
                self._put[asker] = self._link.publish(key)
            words = self._segment.words
            grid = words[System.EPOCH_NS], words[System.PERIOD_NS], self._segment.layout.clock_ns
            content = _PONG.pack(head.launch, received, *grid)
            pong = Envelope(
                _PONG_KIND, self._launch, head.serial, head.serial, 0, 0, monotonic_ns()
            )
            self._put[asker](content, self._sealer.seal(key, pong, content))

    def exchange_pings(self) -> None:
        """Process arrived answers, send the pings that are due, and update the peers' offsets."""
        if self._grid.is_lockstep:
            return
        for clock in self._clocks.values():
            clock.discard_if_outdated()
        for _ in range(len(self._arrived)):
            if self._accept_answer(*self._arrived.popleft()):
                self.taken += 1
            else:
                with self._lock:
                    self.refused += 1
        self._now_ns = now_ns = monotonic_ns()
        for rack, clock in self._clocks.items():
            if clock.peer.is_present and now_ns >= clock.due_ns:
                self._send_ping(rack, clock, now_ns)
            best = clock.offset.best
            clock.peer.offset_ns = None if best is None else best.offset_ns
            clock.peer.uncertainty_ns = 0 if best is None else best.compute_uncertainty_ns(now_ns)

    def _send_ping(self, rack: str, clock: PeerClock, now_ns: int) -> None:
        """Send a ping and schedule the next one."""
        clock.due_ns = now_ns + (PING_NS if len(clock.offset) >= EAGER_ROUND_TRIPS else EAGER_NS)
        self._serial += 1
        while len(clock.sent) >= MAX_UNANSWERED:
            del clock.sent[next(iter(clock.sent))]
        clock.sent[self._serial] = sent_ns = monotonic_ns()
        head = Envelope(_PING_KIND, self._launch, self._serial, self._serial, 0, 0, sent_ns)
        clock.put(b"", self._sealer.seal(ping_key(self._rack, rack), head, b""))

    def _accept_answer(self, arrived_ns: int, pong: ReceivedMessage) -> bool:
        """Add the round trip of an answer to the measurements of its sender.

        Returns:
            False if the answer is malformed or does not belong to a recent ping of this rack.
        """
        head = self._sealer.open_message(*pong)
        if isinstance(head, Flaw) or head.kind != _PONG_KIND or len(pong.payload) != _PONG.size:
            return False
        clock = self._clocks.get(parse_sender(pong.key))
        launch, received_ns, epoch_ns, period_ns, clock_ns = _PONG.unpack(pong.payload)
        if (
            clock is None
            or launch != self._launch
            or head.launch != clock.peer.launch
            or min(period_ns, clock_ns) < 1
        ):
            return False
        sent = clock.sent.pop(head.serial, None)
        if sent is None or not clock.offset.add_round_trip(
            RoundTrip(sent, received_ns, head.stamp_ns, arrived_ns)
        ):
            return False
        clock.epoch_ns = epoch_ns
        clock.period_ns = period_ns
        clock.clock_ns = clock_ns
        return True

    def is_unmeasured(self, peer: PeerRack, tick: int) -> bool:
        """Return True if a rack has been present for `REPORT_UNKNOWN_NS` without a clock offset.

        Messages from such a rack are held back, because their age is unknown. In lockstep no offset
        is needed, so the result is always False.
        """
        is_unknown = peer.is_present and peer.offset_ns is None and not self._grid.is_lockstep
        return is_unknown and tick - peer.since > self._grid.ticks_in(REPORT_UNKNOWN_NS)

    def write_counts(self, record: Any) -> None:
        """Write the counters into their group of the adapter's status."""
        fill_counts(record, (self.taken, self.answered, self.withheld, self.refused))

    def write_clock(self, out: Any, rack: str, tick: int) -> None:
        """Write offset, uncertainty and speed of a rack's clock into its presence message.

        Without a measurement, uncertainty and round trip are -1, or 0 in lockstep.

        Args:
            out: The message to fill, a `rack.levels.peer.PeerPresence`.
            rack: Name of the other rack.
            tick: Current tick of this rack.
        """
        clock = self._clocks[rack]
        out.steps = clock.offset.steps
        best = clock.offset.best
        if best is None:
            out.offset = out.ahead = out.speed = 0.0
            out.uncertainty = out.round_trip = 0.0 if self._grid.is_lockstep else -1.0
            return
        out.offset = best.offset_ns * 1e-9
        out.round_trip = best.duration_ns * 1e-9
        out.uncertainty = best.compute_uncertainty_ns(self._now_ns) * 1e-9
        # The other rack's simulated time: 0 before its tick 0, or if its epoch is unknown.
        real_ns = self._grid.stamp_ns(tick) + best.offset_ns - clock.epoch_ns
        theirs = max(0, real_ns) * clock.clock_ns // clock.period_ns if clock.epoch_ns else 0
        out.ahead = (theirs - self._grid.time_ns(tick)) * 1e-9
        out.speed = clock.clock_ns / clock.period_ns

"""The clocks of other racks next to ours: the offset of their CLOCK_MONOTONIC, by round trips with
four stamps.

A ping is stamped when it is sent and when it arrives there, the answer when it is sent there and
when it arrives here. However long each way took, the true offset is within half the round trip of
the middle: NTP's bound, which asymmetric ways cannot break. The stamps of arrival must not wait for
the adapter's cycle. They are the one thing that a callback takes, in a thread of the network's; it
answers at once, so that an answer waits for no cycle either.
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
from rack.boards.lan.envelope import Envelope, Flaw, Sealer, kind_of
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import ping_key, pong_key
from rack.boards.lan.link import Arrived, LanLink
from rack.boards.lan.peers import NONE, PeerRack, Peers
from rack.levels.peer import DRIFT_PPM

RECENT = 32
"""Round trips of which the best one counts."""
PING_NS = 500_000_000
EAGER_NS = 20_000_000
"""Time between two pings to a rack; the second before `EAGER` round trips have come back, to know
it soon."""
EAGER = 8
UNANSWERED = 64
"""Newest pings to a rack whose answers still count: the round trip may take more than a second."""
ANSWER_NS = 5_000_000
"""Shortest time between two answers to one rack: a flood of pings is not answered by one of
pongs."""
MOST_ASKERS = 1024
"""Racks that get answers."""
UNKNOWN_NS = 1_000_000_000
"""Time after which a clock that is not known is reported."""
UNREAD = 64
"""Answers that wait for a cycle, at most; a newer one overwrites the oldest."""
_PONG = Struct("<Q4q")
_PING_KIND = kind_of("ping", 1, np.dtype([]))
_PONG_KIND = kind_of("pong", 1, np.dtype([("launch", "<u8"), ("stamps", "<i8", 4)]))


class RoundTrip(NamedTuple):
    """A ping and its answer, ns of CLOCK_MONOTONIC: sent and arrived here, received and answered
    there.
    """

    sent: int
    received: int
    answered: int
    arrived: int

    @property
    def lasted_ns(self) -> int:
        """Time under way, both ways together."""
        return (self.arrived - self.sent) - (self.answered - self.received)

    @property
    def offset_ns(self) -> int:
        """The clock there less ours, if both ways took equally long."""
        return (self.received - self.sent + self.answered - self.arrived) // 2

    def uncertainty_ns(self, now_ns: int) -> int:
        """Return the largest error of the offset at a time here."""
        # The halves of odd numbers are rounded down, once here and once in the offset.
        age = max(0, now_ns - self.sent)
        return self.lasted_ns // 2 + 1 + -(-age * DRIFT_PPM // 1_000_000)


class ClockOffset:
    """The offset of another clock, from the best of the recent round trips.

    One that contradicts the estimate begins a new one: a clock has stepped, as it does while a
    machine sleeps.
    """

    def __init__(self) -> None:
        self._recent: deque[RoundTrip] = deque(maxlen=RECENT)
        self.best: RoundTrip | None = None
        """The round trip with the smallest uncertainty: at one time as at any other, as all grow
        alike."""
        self.steps = 0

    def __len__(self) -> int:
        return len(self._recent)

    def add(self, trip: RoundTrip) -> bool:
        """Take a round trip; False if it cannot be one: it would have taken less than no time."""
        if trip.lasted_ns < 0 or trip.arrived < trip.sent or trip.answered < trip.received:
            return False
        now = trip.arrived
        best = self.best
        if best is not None:
            apart = abs(trip.offset_ns - best.offset_ns)
            if apart > trip.uncertainty_ns(now) + best.uncertainty_ns(now):
                self._recent.clear()
                self.steps += 1
        self._recent.append(trip)
        self.best = min(self._recent, key=lambda found: found.uncertainty_ns(now))
        return True

    def forget(self) -> None:
        """Begin anew."""
        self._recent.clear()
        self.best = None


@dataclass
class PeerClock:
    """The clock of one rack, and its grid: CLOCK_MONOTONIC of its tick 0, 0 before that; its
    period; simulated time.
    """

    peer: PeerRack
    put: Any = None
    offset: ClockOffset = field(default_factory=ClockOffset)
    sent: dict[int, int] = field(default_factory=dict)
    due_ns: int = 0
    met: tuple[int, int] = (NONE, 0)
    epoch_ns: int = 0
    period_ns: int = 1
    clock_ns: int = 0

    def begin(self) -> None:
        """Forget what was measured, if that was another launch, or before the rack was lost."""
        met = (self.peer.launch, self.peer.losses)
        if met != self.met:
            self.met = met
            self.due_ns = 0
            self.epoch_ns = 0
            self.clock_ns = 0
            self.offset.forget()
            self.sent.clear()

    def time_ns(self, stamp_ns: int) -> int:
        """Return its simulated time at a CLOCK_MONOTONIC of its machine; 0 before its tick 0."""
        return (
            max(0, stamp_ns - self.epoch_ns) * self.clock_ns // self.period_ns
            if self.epoch_ns
            else 0
        )


class Clocks:
    """Compares the clocks of all peers with ours; not in lockstep, where all racks have one
    simulated time.

    Pings of other racks are answered from the network's threads, each rack's at a bounded rate.
    """

    def __init__(self, segment: Segment, peers: Peers, launch: int, grid: OwnGrid) -> None:
        self._segment = segment
        self._rack = segment.rack
        self._launch = launch
        self._grid = grid
        self._clocks = {peer.rack: PeerClock(peer) for peer in peers}
        self._arrived: deque[tuple[int, Arrived]] = deque(maxlen=UNREAD)
        self.taken = self.answered = self.withheld = self.refused = 0
        self._put: dict[str, Any] = {}
        self._again: dict[str, int] = {}
        # Each link of the network has its own thread.
        self._lock = Lock()
        # Of no ping that an adapter before this one may have sent.
        self._serial = monotonic_ns()
        self._now_ns = 0

    def open(self, link: LanLink, sealer: Sealer) -> None:
        """Answer other racks, and get ready to ask them."""
        if self._grid.is_lockstep:
            return
        self._link = link
        self._sealer = sealer
        link.on(ping_key("*", self._rack), self._on_ping)
        # A tuple is whole or not there: no lock is needed.
        link.on(
            pong_key("*", self._rack), lambda pong: self._arrived.append((monotonic_ns(), pong))
        )
        for rack, clock in self._clocks.items():
            clock.put = link.publish(ping_key(self._rack, rack))

    def _on_ping(self, ping: Arrived) -> None:
        received = monotonic_ns()
        asker = ping.key.split("/")[1]
        with self._lock:
            again = self._again.get(asker)
            if received < (again or 0) or (again is None and len(self._again) == MOST_ASKERS):
                self.withheld += 1
                return
            head = self._sealer.opened(*ping)
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

    def exchange(self) -> None:
        """Take the answers that have come, and ask again where it is time."""
        if self._grid.is_lockstep:
            return
        for clock in self._clocks.values():
            clock.begin()
        for _ in range(len(self._arrived)):
            if self._is_taken(*self._arrived.popleft()):
                self.taken += 1
            else:
                with self._lock:
                    self.refused += 1
        self._now_ns = now = monotonic_ns()
        for rack, clock in self._clocks.items():
            if clock.peer.is_there and now >= clock.due_ns:
                self._ask(rack, clock, now)
            best = clock.offset.best
            clock.peer.offset_ns = None if best is None else best.offset_ns
            clock.peer.uncertainty_ns = 0 if best is None else best.uncertainty_ns(now)

    def _ask(self, rack: str, clock: PeerClock, now: int) -> None:
        clock.due_ns = now + (PING_NS if len(clock.offset) >= EAGER else EAGER_NS)
        self._serial += 1
        while len(clock.sent) >= UNANSWERED:
            del clock.sent[next(iter(clock.sent))]
        clock.sent[self._serial] = sent = monotonic_ns()
        head = Envelope(_PING_KIND, self._launch, self._serial, self._serial, 0, 0, sent)
        clock.put(b"", self._sealer.seal(ping_key(self._rack, rack), head, b""))

    def _is_taken(self, arrived_ns: int, pong: Arrived) -> bool:
        """Take an answer; return False for one that is damaged, or to nothing that was asked."""
        head = self._sealer.opened(*pong)
        if isinstance(head, Flaw) or head.kind != _PONG_KIND or len(pong.payload) != _PONG.size:
            return False
        clock = self._clocks.get(pong.key.split("/")[1])
        launch, received, epoch, period, clock_ns = _PONG.unpack(pong.payload)
        if (
            clock is None
            or launch != self._launch
            or head.launch != clock.peer.launch
            or min(period, clock_ns) < 1
        ):
            return False
        sent = clock.sent.pop(head.serial, None)
        if sent is None or not clock.offset.add(
            RoundTrip(sent, received, head.stamp_ns, arrived_ns)
        ):
            return False
        clock.epoch_ns = epoch
        clock.period_ns = period
        clock.clock_ns = clock_ns
        return True

    def is_unanswered(self, peer: PeerRack, tick: int) -> bool:
        """Say whether the clock of a rack that is there has not been measured for long: its
        messages are held back.
        """
        is_unknown = peer.is_there and peer.offset_ns is None and not self._grid.is_lockstep
        return is_unknown and tick - peer.since > self._grid.ticks_in(UNKNOWN_NS)

    def count(self, record: Any) -> None:
        """Write the counts into the group of a status."""
        fill_counts(record, (self.taken, self.answered, self.withheld, self.refused))

    def fill(self, out: Any, rack: str, tick: int) -> None:
        """Write what is known of a rack's clock into its mailbox: see `rack.levels.peer`."""
        clock = self._clocks[rack]
        out.steps = clock.offset.steps
        best = clock.offset.best
        if best is None:
            out.offset = out.ahead = out.speed = 0.0
            out.uncertainty = out.round_trip = 0.0 if self._grid.is_lockstep else -1.0
            return
        out.offset = best.offset_ns * 1e-9
        out.round_trip = best.lasted_ns * 1e-9
        out.uncertainty = best.uncertainty_ns(self._now_ns) * 1e-9
        theirs = clock.time_ns(self._grid.stamp_ns(tick) + best.offset_ns)
        out.ahead = (theirs - self._grid.time_ns(tick)) * 1e-9
        out.speed = clock.clock_ns / clock.period_ns

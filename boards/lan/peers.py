"""The other racks, as an adapter sees them: there or lost, and which launch.

Each launch of a rack has a number, which its liveliness token and all its messages carry. Tokens
come and go in any order: the token of a restarted rack may come before that of its last launch has
expired, and both may be there when this adapter itself has just joined. So:

- A launch whose token comes is the one that is there. If another was, that one is lost.
- When its token goes and another one is there, that launch is there; otherwise the rack is lost.
- A launch that another has replaced, and whose token has gone, is over: no late token or message
  brings it back.

In lockstep nothing here follows from when a token comes: the barrier says, cycle by cycle, who is
there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from rack.backplane.message import AnyMessage
from rack.backplane.watch.alarms import Alarm
from rack.levels.level import Finding
from rack.levels.peer import PeerPresence, Presence

NONE = 0
REMEMBERED = 16
"""Launches of one rack that are remembered, and tokens of one rack that are followed at a time, at
most."""
Changes = Callable[[], Iterator[tuple[str, int, bool]]]


@dataclass
class PeerRack:
    """One other rack. `launch`: number of the launch that is there, or was last; 0: none was. Times
    are ticks.

    `tokens` are the launches whose tokens are there, oldest first. `confirm_by`: of a rack that was
    there when an adapter before this one ended, until when its token must have come; -1: it has.
    """

    rack: str
    number: int = 0
    goes_on: bool = False
    """Whether levels keep its last messages while it is lost."""
    presence: Presence = Presence.AWAITED
    launch: int = NONE
    launches: int = 0
    losses: int = 0
    since: int = 0
    offset_ns: int | None = None
    """Its CLOCK_MONOTONIC less that of this machine; None: not measured yet."""
    uncertainty_ns: int = 0
    """Largest error of that."""
    tokens: list[int] = field(default_factory=list)
    confirm_by: int = -1
    findings: list[Finding] = field(default_factory=list)
    _seen: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    _over: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))

    @property
    def is_there(self) -> bool:
        """Whether it is there."""
        return self.presence is Presence.THERE

    def is_over(self, launch: int) -> bool:
        """Say whether another launch has replaced this one for good."""
        return launch in self._over

    def comes(self, launch: int, tick: int) -> None:
        """Note that the token of a launch is there."""
        if launch in self._over or (launch not in self.tokens and len(self.tokens) == REMEMBERED):
            return
        if launch not in self.tokens:
            self.tokens.append(launch)
        if self.is_there and self.launch in (NONE, launch):
            # Without a number it was resumed in lockstep, where launches are not on record.
            self.launch = launch
            self.confirm_by = -1
        else:
            self._enters(launch, tick)

    def goes(self, launch: int, tick: int) -> None:
        """Note that the token of a launch is gone."""
        if launch in self.tokens:
            self.tokens.remove(launch)
        elif launch != self.launch:
            return
        if launch != self.launch:
            self._over.append(launch)
        elif self.tokens:
            self._enters(self.tokens[-1], tick)
        else:
            self.leaves(tick)

    def leaves(self, tick: int) -> None:
        """Note that it is lost."""
        if self.is_there:
            self.presence = Presence.LOST
            self.since = tick
            self.confirm_by = -1
            self.losses += 1
            self.offset_ns = None
            self.findings.append(Finding(Alarm.PEER_LOST, self.number))

    def _enters(self, launch: int, tick: int) -> None:
        """Note that a launch is there that was not, or not any more."""
        self.leaves(tick)
        if launch != self.launch:
            self.offset_ns = None
        is_first = self.presence is Presence.AWAITED
        is_new = launch not in self._seen
        if is_new:
            self.launches += 1
            self._seen.append(launch)
            self.offset_ns = None
        if not is_first:
            alarm = Alarm.PEER_RESTARTED if is_new else Alarm.PEER_BACK
            self.findings.append(Finding(alarm, self.number, tick - self.since))
        self.presence = Presence.THERE
        self.launch = launch
        self.since = tick
        self.confirm_by = -1

    def joins(self, launch: int, tick: int) -> None:
        """Note, in lockstep, that it is there: from the start, or still when this adapter has been
        restarted.
        """
        if self.presence is Presence.AWAITED:
            self.presence = Presence.THERE
            self.launches = 1
            self.since = tick
        self.launch = launch
        self.confirm_by = -1

    def resume(self, message: PeerPresence | AnyMessage, confirm_by: int) -> None:
        """Continue from the message that an adapter before this one wrote: see
        `rack.levels.peer.PeerPresence`.
        """
        self.presence = Presence(message.presence)
        self.launch = message.launch
        self.launches = message.launches
        self.losses = message.losses
        self.since = message.since
        self.confirm_by = confirm_by if self.is_there else -1
        if self.launch:
            self._seen.append(self.launch)

    def fill(self, message: PeerPresence, is_lockstep: bool) -> None:
        """Write what is known into its message; launch numbers differ from run to run."""
        message.presence = self.presence
        message.launch = NONE if is_lockstep else self.launch
        message.launches = self.launches
        message.losses = self.losses
        message.since = self.since


class Peers:
    """All racks with which this one works, by name; others that show up are no peers.

    `arrivals` counts the tokens that have come, of any rack.
    """

    def __init__(self, racks: Iterable[str], go_on: bool = False) -> None:
        self._peers = {rack: PeerRack(rack, number, go_on) for number, rack in enumerate(racks)}
        self._changes: Changes = lambda: iter(())
        self._is_lockstep = False
        self.arrivals = 0

    def watch(self, changes: Changes, is_lockstep: bool = False) -> None:
        """Take what comes and goes from now on from this function: rack, launch, whether it has
        come.
        """
        self._changes = changes
        self._is_lockstep = is_lockstep

    def look(self, tick: int) -> list[Finding]:
        """Note who has come and who has gone; return what to report of it."""
        for rack, launch, is_there in self._changes():
            self.arrivals += is_there
            peer = self._peers.get(rack)
            if peer is None:
                continue
            if not self._is_lockstep:
                (peer.comes if is_there else peer.goes)(launch, tick)
            elif is_there:
                peer.joins(launch, tick)
            else:
                peer.leaves(tick)
        found: list[Finding] = []
        for peer in self:
            if 0 <= peer.confirm_by <= tick:
                peer.leaves(tick)
            if peer.findings:
                found += peer.findings
                peer.findings.clear()
        return found

    @property
    def lost(self) -> list[str]:
        """The racks that were there and are lost."""
        return [peer.rack for peer in self if peer.presence is Presence.LOST]

    def __getitem__(self, rack: str) -> PeerRack:
        return self._peers[rack]

    def __iter__(self) -> Iterator[PeerRack]:
        return iter(self._peers.values())

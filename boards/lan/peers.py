"""Presence of the other racks: whether each is awaited, present or lost, and in which launch.

Each launch of a rack has a number, which is contained in its liveliness token and in all its
messages. Tokens may appear and expire in any order. The token of a restarted rack may appear before
the token of its previous launch has expired, and an adapter that has just joined may find both.
Therefore:

- A new token makes its launch the present one. If another launch was present, that one is lost.
- When the token of the present launch expires and another token remains, the launch of that token
  becomes the present one. If none remains, the rack is lost.
- A launch that was replaced and whose token has expired is superseded. Late tokens or messages
  cannot bring it back.

In lockstep, tokens do not matter: the barrier decides in each cycle which racks are present.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from rack.backplane.message import AnyMessage
from rack.backplane.watch.alarms import Alarm
from rack.levels.level import Finding
from rack.levels.peer import PeerPresence, Presence

NO_LAUNCH = 0
MAX_LAUNCHES = 16
"""Maximum number of launches remembered, and of tokens tracked, for each rack."""
Changes = Callable[[], Iterator[tuple[str, int, bool]]]


@dataclass
class PeerRack:
    """State of one other rack.

    Attributes:
        rack: Name of the rack.
        number: Index of the rack, used in alarms.
        keeps_messages: Whether levels keep using the rack's last messages while the rack is lost.
        presence: Whether the rack is awaited, present or lost.
        launch: Number of the launch that is present or was last present. 0 if there was none.
        launches: Number of different launches seen.
        losses: Number of times the rack was lost.
        since: Tick of the last change of presence.
        offset_ns: CLOCK_MONOTONIC of the rack's machine minus that of this machine, in ns. None if
            not yet measured.
        uncertainty_ns: Largest possible error of `offset_ns` in ns.
        tokens: Launches whose tokens exist, oldest first.
        confirm_by: Tick by which the token must appear, if the rack was present when this adapter
            was restarted. -1 if nothing is to be confirmed.
        findings: Findings that are not yet reported.
        superseded: Launches that another one has replaced and whose tokens have expired.
    """

    rack: str
    number: int = 0
    keeps_messages: bool = False
    presence: Presence = Presence.AWAITED
    launch: int = NO_LAUNCH
    launches: int = 0
    losses: int = 0
    since: int = 0
    offset_ns: int | None = None
    uncertainty_ns: int = 0
    tokens: list[int] = field(default_factory=list)
    confirm_by: int = -1
    findings: list[Finding] = field(default_factory=list)
    superseded: deque[int] = field(default_factory=lambda: deque(maxlen=MAX_LAUNCHES))
    _seen: deque[int] = field(default_factory=lambda: deque(maxlen=MAX_LAUNCHES))

    @property
    def is_present(self) -> bool:
        """Whether the rack is present."""
        return self.presence is Presence.THERE

    def add_token(self, launch: int, tick: int) -> None:
        """Process a new token. Make `launch` the present launch unless it is superseded."""
        if launch in self.superseded or (
            launch not in self.tokens and len(self.tokens) == MAX_LAUNCHES
        ):
            return
        if launch not in self.tokens:
            self.tokens.append(launch)
        if self.is_present and self.launch in (NO_LAUNCH, launch):
            # The launch is unknown if the state was restored in lockstep, which records none.
            self.launch = launch
            self.confirm_by = -1
        else:
            self._mark_present(launch, tick)

    def remove_token(self, launch: int, tick: int) -> None:
        """Process the expiry of a token.

        If it belonged to the present launch, the launch of another token becomes the present one.
        Without another token the rack is lost.
        """
        if launch in self.tokens:
            self.tokens.remove(launch)
        elif launch != self.launch:
            return
        if launch != self.launch:
            self.superseded.append(launch)
        elif self.tokens:
            self._mark_present(self.tokens[-1], tick)
        else:
            self.mark_lost(tick)

    def mark_lost(self, tick: int) -> None:
        """Mark the rack as lost. Has no effect if it is not present."""
        if self.is_present:
            self.presence = Presence.LOST
            self.since = tick
            self.confirm_by = -1
            self.losses += 1
            self.offset_ns = None
            self.findings.append(Finding(Alarm.PEER_LOST, self.number))

    def _mark_present(self, launch: int, tick: int) -> None:
        """Mark the rack as present with `launch`. Add a finding if it was restarted or is back."""
        self.mark_lost(tick)
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

    def restore_state(self, message: PeerPresence | AnyMessage, confirm_by: int) -> None:
        """Restore the state that the adapter wrote before it was restarted.

        Args:
            message: Last `rack.levels.peer.PeerPresence` that the previous adapter wrote.
            confirm_by: Tick by which the token of a rack that was present must reappear.
        """
        self.presence = Presence(message.presence)
        self.launch = message.launch
        self.launches = message.launches
        self.losses = message.losses
        self.since = message.since
        self.confirm_by = confirm_by if self.is_present else -1
        if self.launch:
            self._seen.append(self.launch)

    def write_presence(self, message: PeerPresence, is_lockstep: bool) -> None:
        """Write the presence of the rack into its message.

        The launch is written as 0 in lockstep, because launch numbers differ from run to run.
        """
        message.presence = self.presence
        message.launch = NO_LAUNCH if is_lockstep else self.launch
        message.launches = self.launches
        message.losses = self.losses
        message.since = self.since


class Peers:
    """The racks with which this rack works, indexed by name. Other racks are ignored.

    Attributes:
        arrivals: Number of times any rack has appeared, including racks that are not peers.
    """

    def __init__(self, racks: Iterable[str], keep_messages: bool = False) -> None:
        self._peers = {
            rack: PeerRack(rack, number, keep_messages) for number, rack in enumerate(racks)
        }
        self._changes: Changes = lambda: iter(())
        self._is_lockstep = False
        self.arrivals = 0

    def set_source(self, changes: Changes, is_lockstep: bool = False) -> None:
        """Set the function from which changes of presence are read.

        Args:
            changes: Yields, for each change since its last call, the rack, its launch, and True if
                it has appeared or False if it has gone.
            is_lockstep: Whether the changes come from a barrier instead of liveliness tokens.
        """
        self._changes = changes
        self._is_lockstep = is_lockstep

    def update_presence(self, tick: int) -> list[Finding]:
        """Process the changes of presence since the last call and return the resulting findings."""
        for rack, launch, has_appeared in self._changes():
            self.arrivals += has_appeared
            peer = self._peers.get(rack)
            if peer is None:
                continue
            if not self._is_lockstep:
                (peer.add_token if has_appeared else peer.remove_token)(launch, tick)
            elif not has_appeared:
                peer.mark_lost(tick)
            else:
                # It joins at the start of the run, or is present after a restart of this adapter.
                if peer.presence is Presence.AWAITED:
                    peer.presence = Presence.THERE
                    peer.launches = 1
                    peer.since = tick
                peer.launch = launch
                peer.confirm_by = -1
        findings: list[Finding] = []
        for peer in self:
            if 0 <= peer.confirm_by <= tick:
                peer.mark_lost(tick)
            if peer.findings:
                findings += peer.findings
                peer.findings.clear()
        return findings

    @property
    def lost_racks(self) -> list[str]:
        """Names of the racks that were present and are now lost."""
        return [peer.rack for peer in self if peer.presence is Presence.LOST]

    def __getitem__(self, rack: str) -> PeerRack:
        return self._peers[rack]

    def __iter__(self) -> Iterator[PeerRack]:
        return iter(self._peers.values())

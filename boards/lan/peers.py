"""The other racks, as an adapter sees them: there or lost, and which launch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from rack.levels.peer import Presence

NONE = 0


@dataclass
class PeerRack:
    """One other rack. `launch`: number of the launch that is there, or was last; 0: none was."""

    rack: str
    presence: Presence = Presence.AWAITED
    launch: int = NONE
    launches: int = 0
    losses: int = 0
    since: int = 0
    offset_ns: int | None = None
    """Its CLOCK_MONOTONIC less that of this machine; None: not measured yet."""
    uncertainty_ns: int = 0
    """Largest error of that."""

    @property
    def is_there(self) -> bool:
        """Whether it is there."""
        return self.presence is Presence.THERE

    def comes(self, launch: int, tick: int) -> None:
        """Note that a launch is there."""
        if launch != self.launch:
            self.launches, self.offset_ns = self.launches + 1, None
        self.presence, self.launch, self.since = Presence.THERE, launch, tick

    def goes(self, launch: int, tick: int) -> None:
        """Note that a launch is gone; nothing, if another one has come meanwhile."""
        if launch == self.launch and self.is_there:
            self.presence, self.since = Presence.LOST, tick
            self.losses, self.offset_ns = self.losses + 1, None


class Peers:
    """All racks with which this one exchanges, by name; others that show up are no peers."""

    def __init__(self, racks: Iterable[str]) -> None:
        self._peers = {rack: PeerRack(rack) for rack in racks}
        self._changes: Callable[[], Iterator[tuple[str, int, bool]]] = lambda: iter(())

    def watch(self, changes: Callable[[], Iterator[tuple[str, int, bool]]]) -> None:
        """Take what comes and goes from now on from this function: rack, launch, whether it has come."""
        self._changes = changes

    def look(self, tick: int) -> None:
        """Note who has come and who has gone."""
        for rack, launch, is_there in self._changes():
            if (peer := self._peers.get(rack)) is not None:
                (peer.comes if is_there else peer.goes)(launch, tick)

    def __getitem__(self, rack: str) -> PeerRack:
        return self._peers[rack]

    def __iter__(self) -> Iterator[PeerRack]:
        return iter(self._peers.values())

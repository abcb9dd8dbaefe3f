"""The network in a replay: what a recorded run in lockstep had from it comes again, at the same
ticks. The other racks are not there.

The adapter's mailboxes are given out as they were recorded. Those of racks say, too, who came and
who was lost, and when; what follows from that, alarms and messages that are void, follows again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rack.backplane.segment import Segment
from rack.boards.host.adapter import STATUS
from rack.boards.host.entries import NEVER, Replayed, last_written
from rack.boards.lan.entries import Import
from rack.boards.lan.peers import NONE, Peers
from rack.boards.wiring import Entries, Rows
from rack.levels.peer import PeerPresence, Presence, peer_port


class ReplayedNetwork:
    """What came of the `peers` and `imports` of an adapter, by the recorded messages of its
    ports.
    """

    def __init__(
        self,
        segment: Segment,
        board: str,
        entries: Entries,
        peers: Peers,
        imports: Mapping[str, Import],
    ) -> None:
        self._imports: dict[str, tuple[Import, Replayed]] = {}
        for port, entry in imports.items():
            # After what an adapter before this one has sent.
            _, sent = last_written(segment, f"{board}.{port}")
            self._imports[port] = entry, Replayed(entries[port], port, is_sent=True, since=sent)
        ports = {peer.rack: peer_port(peer.rack) for peer in peers}
        self._shown = [
            Replayed(entries[port], port, is_sent=False) for port in (*ports.values(), STATUS)
        ]
        changes = [change for rack, port in ports.items() for change in _seen(rack, entries[port])]
        self._changes = sorted(changes)
        self._tick = NEVER

    def begin(self, tick: int) -> None:
        """Begin the cycle released at `tick`."""
        self._tick = tick

    def changes(self) -> Iterator[tuple[str, int, bool]]:
        """Yield who has come and who has gone by now, as a barrier does."""
        while self._changes and self._changes[0][0] <= self._tick:
            _, rack, is_there = self._changes.pop(0)
            yield rack, NONE, is_there

    def give(self, write: Mapping[str, Any], tick: int) -> None:
        """Write what was written in this cycle."""
        for entry, sent in self._imports.values():
            entry.look(tick)
            if sent.exchange({}, write, tick):
                entry.comes(tick)
        for shown in self._shown:
            shown.exchange({}, write, tick)


def _seen(rack: str, rows: Rows) -> Iterator[tuple[int, str, bool]]:
    """Yield when a rack came, and when it was lost."""
    message = PeerPresence.zeros({})
    before = int(Presence.AWAITED)
    for tick, _, content in rows:
        message.raw[:] = content
        if message.presence != before:
            before = int(message.presence)
            yield tick, rack, before == Presence.THERE

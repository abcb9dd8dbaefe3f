"""The network in a replay: recorded messages are repeated at the recorded ticks.

The adapter's mailboxes are written as they were recorded; the other racks do not run. The recorded
mailboxes of the racks also tell when a rack appeared and when it was lost. Alarms and void messages
follow from that as in the recorded run.
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
    """Repeats what a recorded run received from the peers and imports of an adapter."""

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
            # Continue after the last message that the adapter sent before a restart.
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
        """Start the cycle released at `tick`, up to which changes are reported."""
        self._tick = tick

    def changes(self) -> Iterator[tuple[str, int, bool]]:
        """Yield the changes of presence up to this cycle, in the form of `Barrier.take_changes`."""
        while self._changes and self._changes[0][0] <= self._tick:
            _, rack, is_there = self._changes.pop(0)
            yield rack, NONE, is_there

    def give(self, write: Mapping[str, Any], tick: int) -> None:
        """Write the messages that were recorded in this cycle.

        Args:
            write: Output ports of the adapter, by name.
            tick: Release of the cycle.
        """
        for entry, sent in self._imports.values():
            entry.look(tick)
            if sent.exchange({}, write, tick):
                entry.comes(tick)
        for shown in self._shown:
            shown.exchange({}, write, tick)


def _seen(rack: str, rows: Rows) -> Iterator[tuple[int, str, bool]]:
    """Yield the tick, the rack and True when it appeared, or False when it was lost."""
    message = PeerPresence.zeros({})
    last_presence = int(Presence.AWAITED)
    for tick, _, content in rows:
        message.raw[:] = content
        if message.presence != last_presence:
            last_presence = int(message.presence)
            yield tick, rack, last_presence == Presence.THERE

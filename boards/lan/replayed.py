"""The network in a replay: recorded messages are repeated at the recorded ticks.

The adapter's mailboxes are written as they were recorded; the other racks do not run. The recorded
mailboxes of the racks also show when a rack appeared and when it was lost. Alarms and void messages
follow from that as in the recorded run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rack.backplane.segment import Segment
from rack.boards.host.adapter import STATUS
from rack.boards.host.entries import NEVER, ReplayedEntry, read_last_written
from rack.boards.lan.entries import Import
from rack.boards.lan.peers import NO_LAUNCH, Peers
from rack.boards.wiring import MessageRows, RecordedEntries
from rack.levels.peer import PeerPresence, Presence, format_peer_port


class ReplayedNetwork:
    """Repeats the imported messages and the changes of presence of a recorded run."""

    def __init__(
        self,
        segment: Segment,
        board: str,
        entries: RecordedEntries,
        peers: Peers,
        imports: Mapping[str, Import],
    ) -> None:
        self._imports: dict[str, tuple[Import, ReplayedEntry]] = {}
        for port, entry in imports.items():
            # Continue after the last message that the adapter sent before a restart.
            _, sent = read_last_written(segment, f"{board}.{port}")
            self._imports[port] = (
                entry,
                ReplayedEntry(entries[port], port, is_sent=True, since=sent),
            )
        ports = {peer.rack: format_peer_port(peer.rack) for peer in peers}
        self._shown = [
            ReplayedEntry(entries[port], port, is_sent=False) for port in (*ports.values(), STATUS)
        ]
        changes = [
            change
            for rack, port in ports.items()
            for change in _list_presence_changes(rack, entries[port])
        ]
        self._changes = sorted(changes)
        self._tick = NEVER

    def start_cycle(self, tick: int) -> None:
        """Start the cycle released at `tick`. `take_changes` yields the changes up to this tick."""
        self._tick = tick

    def take_changes(self) -> Iterator[tuple[str, int, bool]]:
        """Yield the recorded changes of presence up to this cycle that were not yielded before.

        As in `Barrier.take_changes`, a change is a tuple (rack, launch, is present). The launch is
        not recorded and always `NO_LAUNCH`.
        """
        while self._changes and self._changes[0][0] <= self._tick:
            _, rack, has_appeared = self._changes.pop(0)
            yield rack, NO_LAUNCH, has_appeared

    def write_recorded(self, write: Mapping[str, Any], tick: int) -> None:
        """Write the messages that were recorded in this cycle to the adapter's ports.

        Args:
            write: Dictionary from names to output ports of the adapter.
            tick: Release of the cycle.
        """
        for entry, sent in self._imports.values():
            entry.update_presence(tick)
            if sent.exchange_messages({}, write, tick):
                entry.mark_present(tick)
        for shown in self._shown:
            shown.exchange_messages({}, write, tick)


def _list_presence_changes(rack: str, rows: MessageRows) -> Iterator[tuple[int, str, bool]]:
    """Yield tick, rack, and True (appeared) or False (lost) for each change of presence."""
    message = PeerPresence.zeros({})
    last_presence = int(Presence.AWAITED)
    for tick, _, content in rows:
        message.raw[:] = content
        if message.presence != last_presence:
            last_presence = int(message.presence)
            yield tick, rack, last_presence == Presence.THERE

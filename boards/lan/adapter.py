"""The network adapter: a bus adapter whose other side is the network, on eclipse-zenoh.

It is an ordinary board with a rate, and a priority above its neighbours'. In its cycles it sends what it exports, takes
what has come of its imports, notes who is there, and answers questions; in between only the network's own threads run,
which have its core and priority. Nothing here waits, but in lockstep, where time stands still meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.message import Message, MessageType, State
from rack.backplane.segment import Segment
from rack.backplane.words import Head
from rack.boards.adapters.adapter import STATUS, Adapter
from rack.boards.adapters.entries import Rows
from rack.boards.lan.config import LanParams
from rack.boards.lan.entries import Export, Import
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.link import LanLink
from rack.boards.lan.lockstep import Barrier
from rack.boards.lan.messages import status_of
from rack.boards.lan.peers import Peers
from rack.levels.level import Input, LevelContext, MadePorts, Output, Ports
from rack.levels.peer import PEER, peer_port
from rack.levels.tables import read_params


class LanAdapter(Adapter):
    """Exchanges mailboxes with other racks. Its status shows every entry and every other rack."""

    params = LanParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._table = read_params(LanParams, context.params)
        self._peers = Peers(self._table.racks)
        self._exports: dict[str, Export] = {}
        self._imports: dict[str, Import] = {}
        self._link: LanLink | None = None
        self._barrier: Barrier | None = None

    @classmethod
    def made_ports(cls, params: Mapping[str, Any], types: Mapping[str, MessageType]) -> MadePorts:
        """Return a port to read for each export, one to write for each import, and the status."""
        table = LanParams.found_in(params)
        if table is None:
            return MadePorts(is_whole=False)
        known = {port: entry for port, entry in table.exports.items() if entry.source in types}
        inputs = {port: Input(types[entry.source], entry.source) for port, entry in known.items()}
        outputs = {}
        for port, entry in table.imports.items():
            try:
                outputs[port] = Output(entry.message_type(), max_age_s=entry.max_age_ms * 1e-3)
            except LookupError:
                continue
        is_whole = len(known) == len(table.exports) and len(outputs) == len(table.imports)
        outputs |= {peer_port(rack): Output(PEER) for rack in table.racks}
        outputs[STATUS] = Output(status_of(table.exports, table.imports))
        return MadePorts(inputs, outputs, is_whole)

    def attach(self, segment: Segment, entries: Mapping[str, Rows] | None) -> None:
        """Take the segment: its grid, and the mailboxes to exchange."""
        words = segment.words
        launch = xxh3(bytes(words[Head.LAUNCHER_PID : Head.CREATED_NS + 1]))
        self._rack, self._launch, self._grid = segment.rack, launch, OwnGrid(segment)
        self._exports = {port: Export(segment, table, launch) for port, table in self._table.exports.items()}
        for port, entry in self._table.imports.items():
            peer = self._peers[entry.rack]
            self._imports[port] = Import(segment, f"{self.context.board}.{port}", entry, peer)
        if self._grid.is_lockstep and self._table.racks:
            self._barrier = Barrier(segment, self.context.board, self._table.racks)

    def open(self) -> None:
        """Open the session: its threads inherit core and priority of the board. Raises `LevelError`."""
        self._link = link = LanLink(self._rack, self._table)
        way, barrier = self._barrier or link, self._barrier
        for entry in self._imports.values():
            entry.open(way, link.sealer)
        for export in self._exports.values():
            export.open(way, link.sealer)
        if barrier is not None:
            barrier.open(link, self._launch)
        self._peers.watch(link.watch_alive() if barrier is None else barrier.changes)
        # Last: whoever sees it knows all subscriptions, and loses nothing.
        link.declare_alive(self._launch, 0 if barrier is None else barrier.cycle_ns)

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Exchange what is due."""
        cycle = tick // self.context.every
        for port, export in self._exports.items():
            if self._is_due(self._table.exports[port].rate_hz, cycle):
                export.exchange(getattr(read, port), self._grid, tick)
        if self._barrier is not None and not self._barrier.meet(tick):
            return
        self._peers.look(tick)
        for port, entry in self._imports.items():
            if self._is_due(self._table.imports[port].rate_hz, cycle):
                entry.exchange(getattr(write, port), self._grid, tick)
        self._report(write, tick)

    def _is_due(self, rate_hz: float, cycle: int) -> bool:
        return cycle % max(1, round(1.0 / (rate_hz * self.context.period_s))) == 0

    def _report(self, write: Ports, tick: int) -> None:
        status: Message = write.status
        for port, export in self._exports.items():
            export.fill(getattr(status, f"export_{port}"))
        for port, entry in self._imports.items():
            entry.fill(getattr(status, f"import_{port}"), self._grid, tick)
        for peer in self._peers:
            out = getattr(write, peer_port(peer.rack))
            out.presence, out.launches, out.losses, out.since = peer.presence, peer.launches, peer.losses, peer.since
        absent = [peer.rack for peer in self._peers if not peer.is_there]
        status.state = State.HOLDING if absent else State.EXECUTING
        status.reason = f"rack '{absent[0]}' is not there" if absent else ""

    def close(self) -> None:
        """Leave the network."""
        if self._barrier is not None:
            self._barrier.close()
        if self._link is not None:
            self._link.close()

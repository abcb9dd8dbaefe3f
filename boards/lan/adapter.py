"""Network adapter, which connects the rack to other racks through eclipse-zenoh.

It is an ordinary board with a rate and a higher priority than its neighbours. In each cycle it
sends exports, receives imports, updates which racks are present, and sets the emergency stop on
permitted requests. Between cycles only zenoh's threads run, with the core and the priority of the
board. The adapter never waits, except in lockstep, where simulated time stands still while it does.

A restarted adapter continues from its own mailboxes. It writes the status before the messages that
are counted in it. If it is killed in between, a message is lost, but none is delivered twice.

In a replay there is no network: see `rack.boards.lan.replayed`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.layout import Layout
from rack.backplane.message import Message, State, fill_counts
from rack.backplane.segment import Segment
from rack.backplane.words import Head, System, encode_switch
from rack.boards.host.adapter import STATUS, Adapter
from rack.boards.host.entries import read_last_written
from rack.boards.lan.clocks import Clocks
from rack.boards.lan.config import LanTable
from rack.boards.lan.entries import Export, Import
from rack.boards.lan.envelope import Flaw, Sealer
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.link import RETRY_MS, LanLink
from rack.boards.lan.lockstep import Barrier
from rack.boards.lan.peers import Peers
from rack.boards.lan.remote_estop import EstopResponder
from rack.boards.lan.replayed import ReplayedNetwork
from rack.boards.lan.status import build_status_class
from rack.boards.wiring import RecordedEntries
from rack.levels.errors import LevelError
from rack.levels.level import ConfiguredPorts, Input, LevelContext, Output, TimedOutput
from rack.levels.peer import PeerPresence, format_peer_port
from rack.levels.ports import WrittenPort
from rack.levels.tables import read_params

_LAUNCH_MASK = (1 << 62) - 1


class LanAdapter(Adapter):
    """Adapter that exchanges mailboxes with other racks over a network.

    Besides the imported mailboxes it writes a status, with counters for every export and import,
    and one mailbox with the presence of each other rack.
    """

    params = LanTable
    wired_by = "params.export"

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._table = table = read_params(LanTable, context.params)
        self._peers = Peers(table.racks, table.on_peer_loss == "go on")
        self._exports: dict[str, Export] = {}
        self._imports: dict[str, Import] = {}
        self._link: LanLink | None = None
        self._flaws: Sequence[int] = ()
        self._barrier: Barrier | None = None
        self._replayed: ReplayedNetwork | None = None

    @classmethod
    def list_names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names of the peers and of the senders that may set the emergency stop.

        Alarms contain indices into this sequence. It is empty if the parameters are invalid.
        """
        table = _read_table(params)
        return () if table is None else tuple(dict.fromkeys([*table.racks, *table.estop_from]))

    @classmethod
    def build_ports(
        cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]
    ) -> ConfiguredPorts:
        """Return an input for each export, and outputs for imports, peers and the status.

        The result is marked as incomplete if the parameters are invalid or refer to an unknown
        mailbox or message class.
        """
        table = _read_table(params)
        if table is None:
            return ConfiguredPorts(is_complete=False)
        known_exports = {
            port: entry for port, entry in table.exports.items() if entry.source in types
        }
        inputs = {
            port: Input(types[entry.source], entry.source) for port, entry in known_exports.items()
        }
        # The status depends on the export of the same name, if there is one.
        rests_on = inputs.get(STATUS)
        status = Output(build_status_class(table.exports, table.imports), rests_on=rests_on)
        outputs: dict[str, WrittenPort[Any, Any]] = {STATUS: status}
        for port, entry in table.imports.items():
            try:
                outputs[port] = TimedOutput(entry.find_message_class(), entry.max_age_ms * 1e-3)
            except LookupError:
                continue
        is_whole = len(known_exports) == len(table.exports) and len(outputs) == 1 + len(
            table.imports
        )
        outputs |= {format_peer_port(rack): Output(PeerPresence) for rack in table.racks}
        return ConfiguredPorts(inputs, outputs, is_whole)

    @classmethod
    def list_replayed_ports(cls, params: Mapping[str, Any], layout: Layout) -> Mapping[str, bool]:
        """Return the output ports whose recorded messages a replay writes again.

        Returns:
            A dictionary from each such port to True for an import, whose messages are sent one by
            one, or False for the status or a presence.
        """
        imports = read_params(LanTable, params).imports
        return {port: port in imports for port in cls.build_ports(params, {}).outputs}

    def attach_segment(self, segment: Segment, entries: RecordedEntries | None) -> None:
        """Attach to the segment. After a restart, restore the state from the adapter's mailboxes.

        Args:
            segment: Segment of the rack.
            entries: In a replay, the recorded messages of each port. None in a live run.
        """
        words = segment.words
        board = self.context.board
        table = self._table
        launch = xxh3(bytes(words[Head.LAUNCHER_PID : Head.CREATED_NS + 1])) & _LAUNCH_MASK
        self._words = words
        self._rack = segment.rack
        self._launch = launch
        self._grid = OwnGrid(segment, self.context.every)
        # After a restart, the tokens of running racks reappear at the latest after the lease time
        # plus the time between two attempts to connect.
        confirm_by_tick = words[System.TICK] + self._grid.ticks_in(
            (table.lease_ms + RETRY_MS[1]) * 1e6
        )
        for peer in self._peers:
            last_presence, _ = read_last_written(segment, f"{board}.{format_peer_port(peer.rack)}")
            if last_presence is not None:
                peer.restore_state(last_presence, confirm_by_tick)
        self._imports = {
            port: Import(segment, f"{board}.{port}", entry, self._peers[entry.rack], self._grid)
            for port, entry in table.imports.items()
        }
        if entries is not None:
            self._replayed = ReplayedNetwork(segment, board, entries, self._peers, self._imports)
            self._peers.set_source(self._replayed.take_changes, is_lockstep=True)
            return
        self._clocks = Clocks(segment, self._peers, launch, self._grid)
        self._exports = {
            port: Export(segment, entry, launch, self._grid)
            for port, entry in table.exports.items()
        }
        sender_names = self.list_names(self.context.params)
        subjects = {name: sender_names.index(name) for name in table.estop_from}
        self._desk = EstopResponder(segment, self._grid, subjects, self.findings)
        status, tick = read_last_written(segment, f"{board}.{STATUS}")
        if status is not None:
            for port, export in self._exports.items():
                export.restore_counts(getattr(status, f"export_{port}"))
            for port, entry in self._imports.items():
                entry.restore_counts(getattr(status, f"import_{port}"), tick)
            self._desk.restore_counts(status.desk)
            self._flaws = status.flaws.tolist()
        if self._grid.is_lockstep and table.racks:
            self._barrier = Barrier(segment, board, table.racks, self._peers.lost_racks)

    def open_connections(self) -> None:
        """Open the session and start to exchange messages. Does nothing in a replay.

        The session's threads inherit the core and the priority of the board.

        Raises:
            LevelError: An endpoint or a credential cannot be used.
        """
        if self._replayed is not None:
            return
        self._link = link = LanLink(self._rack, self._table)
        link.sealer.flaws |= zip(Flaw, self._flaws, strict=False)
        barrier = self._barrier
        # A step is sealed as a whole, so the messages in it need no signatures.
        sealer = Sealer() if barrier else link.sealer
        for entry in self._imports.values():
            entry.open(barrier or link, sealer)
        for export in self._exports.values():
            export.open(barrier or link, sealer)
        self._clocks.open(link, link.sealer)
        self._desk.open(link, self._launch)
        if barrier is not None:
            barrier.open(link, self._launch)
            # The previous adapter may have died before its last step had left the machine, so
            # prepare that step again.
            if barrier.last_done_tick >= 0:
                for export in self._exports.values():
                    export.resend_last(barrier.last_done_tick, self.context.every)
                barrier.prepare_step(barrier.last_done_tick)
        self._peers.set_source(
            link.watch_tokens() if barrier is None else barrier.take_changes, barrier is not None
        )
        # Declare the token last: a rack that sees it then also sees all subscriptions and misses
        # no message.
        link.declare_token(self._launch, 0 if barrier is None else barrier.cycle_ns)

    def process(self, tick: int) -> None:
        """Send and receive the messages that are due, and write the status.

        In a replay, write the messages that were recorded in this cycle.
        """
        if self._replayed is not None:
            self._replayed.start_cycle(tick)
            self._update_presence(tick)
            self._replayed.write_recorded(self.ports, tick)
            return
        cycle = tick // self.context.every
        if self._barrier is None:
            self._update_presence(tick)
        for export in self._exports.values():
            if cycle % export.every == 0:
                export.send_newest(tick)
        if self._barrier is not None:
            if not self._barrier.exchange_steps(tick):
                return
            self._update_presence(tick)
        for port, entry in self._imports.items():
            entry.update_presence(tick)
            if cycle % entry.every == 0:
                entry.deliver_newest(self.ports[port], tick)
        self._clocks.exchange_pings()
        self._desk.answer_requests(tick)
        self._write_status(tick)

    def _update_presence(self, tick: int) -> None:
        """Update which racks are present. If a rack has appeared, resend all exports.

        With `on_peer_loss = "stop"`, stop the arm while a rack is lost.
        """
        arrivals = self._peers.arrivals
        self.findings += self._peers.update_presence(tick)
        must_stop = self._table.on_peer_loss == "stop" and bool(self._peers.lost_racks)
        if must_stop != bool(self._words[System.PEER_STOP] & 1):
            # In lockstep, other boards and the clock may be ahead of `tick` within this cycle.
            since = tick + self.context.every if self._grid.is_lockstep else tick
            self._words[System.PEER_STOP] = encode_switch(since, must_stop)
        if self._peers.arrivals != arrivals:
            for export in self._exports.values():
                export.must_resend = True

    def _write_status(self, tick: int) -> None:
        """Write the status with all counters, and the presence and clock of each other rack."""
        status = self.ports[STATUS]
        self._clocks.write_counts(status.clocks)
        for port, export in self._exports.items():
            export.write_counts(getattr(status, f"export_{port}"))
        for port, entry in self._imports.items():
            entry.write_counts(getattr(status, f"import_{port}"), tick)
        self._desk.write_counts(status.desk)
        for peer in self._peers:
            out = self.ports[format_peer_port(peer.rack)]
            self._clocks.write_clock(out, peer.rack, tick)
            peer.write_presence(out, self._grid.is_lockstep)
        if self._link is not None and not self._grid.is_lockstep:
            fill_counts(status.flaws, self._link.sealer.flaws.values())
        status.reason = reason = self._find_trouble(tick)
        status.state = State.HOLDING if reason else State.EXECUTING

    def _find_trouble(self, tick: int) -> str:
        """Return the reason why messages of another rack are missing or too old.

        Returns:
            The reason. An empty string if all racks are present and all messages recent enough.
        """
        for peer in self._peers:
            if not peer.is_present:
                return f"rack '{peer.rack}' is {'lost' if peer.launches else 'not there yet'}"
            if len(peer.tokens) > 1:
                return f"{len(peer.tokens)} racks are named '{peer.rack}'"
            if self._clocks.is_unmeasured(peer, tick):
                return f"clock of rack '{peer.rack}' is not known: it does not answer pings"
        ports = [port for port, entry in self._imports.items() if entry.is_old(tick)]
        return f"'{self._table.imports[ports[0]].source}' is older than max_age_ms" if ports else ""

    def close(self) -> None:
        """Close the session. In lockstep, first inform the other racks if the run is over."""
        if self._barrier is not None:
            self._barrier.close()
        if self._link is not None:
            self._link.close()


def _read_table(params: Mapping[str, Any]) -> LanTable | None:
    """Parse the `[adapter.lan]` table. Return None if it is invalid."""
    try:
        return read_params(LanTable, params)
    except LevelError:
        return None

"""The bus adapter between the real-time side and host boards, also called bridge.

A bridge is an ordinary board with a rate and a priority. Each entry of its table passes one mailbox
to the other side. The side of the source mailbox determines the direction.

Into real time, the bridge takes messages from the ring of a host board, checks them, and writes
them to its mailbox `<bridge>.<port>`. Levels read that mailbox at ticks like any other, so that
runs are repeatable from there on. Out of real time, it reads a level's mailbox at ticks and writes
a copy, which host boards can read at any time.

A host board that hangs, ends or floods its ring does not affect the real-time side: the ring is
bounded, a cycle processes at most `most` messages of an entry, and the bridge never waits in real
time. Its status has counters for each entry.

In lockstep a program runs only within cycles of its bridges, after the exchange, and the cycle
lasts until the program waits. The program is due at its start, when a message has arrived, and when
its time-out has passed. Its messages are taken in a later cycle, once the simulated time
`[host.x] computing_ms` has passed, however long the program took in reality. They therefore enter
at ticks that the config determines. If a program has several bridges, lockstep releases all tasks
one at a time.

The clock could release programs like tasks instead. But then they would need a rate, and a message
would wait for their next cycle.

A replay does not run host boards. The recorded messages enter again, each at its tick.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.clock.wake import CHECK_S
from rack.backplane.layout import Layout, TaskSpec
from rack.backplane.message import Message, State, Status, field, make_message
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.boards.host.adapter import STATUS, Adapter
from rack.boards.host.entries import (
    ActiveEntry,
    AdapterEntry,
    AdapterParams,
    EntryConfig,
    EntryCounters,
    InwardEntry,
    OutwardEntry,
    ReplayedEntry,
    read_last_written,
)
from rack.boards.wiring import RecordedEntries
from rack.levels.errors import CannotGoOn
from rack.levels.level import ConfiguredPorts, Input, LevelContext, Output, QueuedOutput, Sender
from rack.levels.tables import read_params

LONGEST_S = 30.0
"""Longest real time of one turn of a program in lockstep, its start and imports included."""


class BusAdapter(Adapter):
    """Copies mailboxes between the real-time side and host boards.

    The state in its status is DONE when the programs of all its host boards are finished.
    """

    params = AdapterParams
    wired_by = "params.pass"
    joins_sides = True

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._tables = read_params(AdapterParams, context.params).entries
        self._counts = {port: EntryCounters() for port in self._tables}
        self._entries: list[tuple[EntryConfig, ActiveEntry]] = []
        self._turns: list[HostTurn] = []
        self._hosts: dict[str, memoryview] = {}
        self._before: dict[str, bytes] = {}
        self._statuses: ReplayedEntry | None = None

    @classmethod
    def build_ports(
        cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]
    ) -> ConfiguredPorts:
        """Return an input and an output port for each `pass` entry, and an output for the status.

        Args:
            params: Parameters of the adapter's board.
            types: Message classes of the mailboxes known so far.
        """
        entries = AdapterParams.read_entries(params)
        known = {port: entry for port, entry in entries.items() if entry.source in types}
        inputs = {
            port: Input(types.get(entry.source, AdapterEntry), entry.source)
            for port, entry in entries.items()
        }
        # An entry that passes each message once needs a queue. The adapter writes mailboxes for
        # host boards without these ports.
        outputs = {
            port: (QueuedOutput if entry.asynchronous else Output)(
                types[entry.source], rests_on=inputs[port]
            )
            for port, entry in known.items()
        }
        is_whole = bool(entries) and known == entries
        return ConfiguredPorts(
            inputs, {**outputs, STATUS: Output(build_status_class(entries))}, is_whole
        )

    @classmethod
    def list_replayed_ports(cls, params: Mapping[str, Any], layout: Layout) -> Mapping[str, bool]:
        """Return the ports that pass messages of host boards, and the status port.

        See `Adapter.list_replayed_ports` for the arguments and the result.
        """
        hosts = {host.name for host in layout.hosts}
        sent = {
            port: entry.asynchronous
            for port, entry in AdapterParams.read_entries(params).items()
            if layout.find_mailbox(entry.source).writer in hosts
        }
        return {**sent, STATUS: False}

    def attach_segment(self, segment: Segment, entries: RecordedEntries | None) -> None:
        """Open the mailboxes of the host side. In a replay, open the recorded messages instead.

        Args:
            segment: Segment of the rack.
            entries: In a replay, the recorded messages, keyed by port. Otherwise None.
        """
        layout = segment.layout
        hosts = {host.name for host in layout.hosts}
        board = self.context.board
        # After a restart, continue with the messages and counters of the previous process.
        status, tick = read_last_written(segment, f"{board}.{STATUS}")
        for port, table in self._tables.items():
            count = self._counts[port]
            if status is not None:
                count.restore_counts(getattr(status, port), tick)
            mailbox = f"{board}.{port}"
            before, since = read_last_written(segment, mailbox)
            writer = layout.find_mailbox(table.source).writer
            entry: ActiveEntry
            if writer not in hosts:
                entry = OutwardEntry(segment, mailbox, port, table, count)
            else:
                if before is not None:
                    self._before[port] = bytes(before.raw)
                if entries is None:
                    self._hosts[writer] = segment.get_block(writer)
                    entry = InwardEntry(segment, port, table, count)
                else:
                    entry = ReplayedEntry(entries[port], port, table.asynchronous, since)
            self._entries.append((table, entry))
        if segment.words[System.LOCKSTEP] and entries is None:
            self._turns = [
                HostTurn(segment, host)
                for host in layout.hosts
                if board in layout.find_pacers(host)
            ]
        if entries is not None:
            self._statuses = ReplayedEntry(entries[STATUS], STATUS, is_sent=False)

    def process(self, tick: int) -> None:
        """Exchange the messages of all due entries. In lockstep, then run the due programs."""
        for port, message in self._before.items():
            out = self.ports[port]
            (out.message if isinstance(out, Sender) else out).raw[:] = message
        self._before.clear()
        cycle = (tick - self.context.phase) // self.context.every
        for table, entry in self._entries:
            if table.is_due(cycle):
                entry.exchange_messages(self.readings, self.ports, tick)
        for turn in self._turns:
            turn.run_turn(tick)
        if self._statuses is not None:
            self._statuses.exchange_messages(self.readings, self.ports, tick)
        else:
            self._write_status(self.ports[STATUS], tick)

    def _write_status(self, status: Status, tick: int) -> None:
        """Write the counters of all entries and the state of the host boards to the status."""
        for port, count in self._counts.items():
            count.write_counts(getattr(status, port), tick)
        states = {name: block[Block.STATE] for name, block in self._hosts.items()}
        lost = [name for name, block in self._hosts.items() if block[Block.LOST]]
        gone = [name for name, state in states.items() if state == TaskState.GIVEN_UP]
        status.state = State.EXECUTING
        status.error = 0
        status.reason = ""
        if lost:
            # Check for a loss first, because it is recorded at the same tick if a lockstep run is
            # repeated. The tick at which the Rack stops restarting a board may differ.
            status.state = State.HOLDING
            status.reason = f"host board '{lost[0]}' is lost: it is being restarted"
        elif gone:
            status.state = State.ERROR
            status.reason = f"host board '{gone[0]}' was given up"
        elif states and all(state == TaskState.ENDED for state in states.values()):
            status.state = State.DONE


class HostTurn(ReleasedTask):
    """Lets a host program run in turns in lockstep, while its adapter waits.

    `rack.boards.host.bus.HostBus` is the other side, in the program's process.
    """

    def __init__(self, segment: Segment, host: TaskSpec) -> None:
        super().__init__(segment, host)
        self._segment = segment

    def run_turn(self, tick: int) -> None:
        """Let the program run until it waits, if it is due in the cycle released at `tick`.

        Raises:
            CannotGoOn: The program has not waited within `LONGEST_S` of real time.
        """
        block = self.block
        # In a state above RUNNING, the program is finished or will not be restarted.
        if (
            block[Block.STATE] > TaskState.RUNNING
            or block[Block.WAITS_UNTIL] > tick
            or not self.can_take_release(tick)
        ):
            return
        block[Block.RELEASED] = tick
        self.wake()
        bound_s = time.monotonic() + LONGEST_S
        while not self.is_settled():
            if self.done.acquire(CHECK_S):
                continue
            if self._segment.words[System.STOP_REQUEST] or not self._segment.launcher_is_alive:
                break
            if time.monotonic() > bound_s:
                raise CannotGoOn(
                    f"the program of host board '{self.spec.name}' has not waited for {LONGEST_S:g}"
                    " s of real time, and lockstep cannot continue without it"
                )
        if block[Block.LOST]:
            # The crate has recorded the clock's tick, which may be later than this cycle.
            block[Block.LOST] = tick + 1


def build_status_class(entries: Mapping[str, EntryConfig]) -> type[Status]:
    """Return the class of an adapter's status, with a group of counters for each entry."""
    groups = {port: field(AdapterEntry, doc=f"entry {port}") for port in entries}
    return make_message("adapter_status", Status, groups)

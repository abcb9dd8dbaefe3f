"""The bridge: a bus adapter between the real-time side and the boards of the host side.

A bridge is an ordinary board with a rate and a priority. Each entry of its table passes one mailbox
across; the side of the source is the direction.

Into real time, the bridge takes messages from the ring of a host board, checks them, and writes
them to its own mailbox `<bridge>.<port>`, which levels read by ticks as any other. From there on a
run is repeatable. Out of real time it reads a level's mailbox by ticks and writes a copy, which
host boards read whenever they like.

A hung, dead or flooding host board costs the real-time side nothing: the ring is bounded, a cycle
looks at no more than `most` messages of an entry, and nothing here waits. The bridge's status shows
it, entry by entry.

In lockstep a program runs only within cycles of its bridges, after the exchange, and the cycle
waits until it waits. It is due when a message has come, when the time has come until which it
waits, and at its start. What it sends is taken in a later cycle, once its computing is over: that
takes the simulated time `[host.x] computing_ms`, however long it really took. So it enters at ticks
that the config determines. If a program has several bridges, lockstep releases all tasks one at a
time.

Alternative considered: a clock that releases programs as it does tasks. They would need a rate, and
a message would wait for their next cycle.

A replay does without host boards: what entered in a recorded run is given out again, each message
at its tick.
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
    AdapterEntry,
    AdapterParams,
    Crossing,
    EntryConfig,
    EntryCount,
    Inward,
    Outward,
    Replayed,
    last_written,
)
from rack.boards.wiring import Entries
from rack.levels.errors import CannotGoOn
from rack.levels.level import Input, LevelContext, MadePorts, Output, QueuedOutput, Sender
from rack.levels.tables import read_params

LONGEST_S = 30.0
"""Real time within which a program in lockstep must wait, or end; its start and imports have as
long."""


class BusAdapter(Adapter):
    """Passes mailboxes between the two sides. Its status is done when the programs of all its host
    boards are.
    """

    params = AdapterParams
    wired_by = "params.pass"
    joins_sides = True

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._tables = read_params(AdapterParams, context.params).entries
        self._counts = {port: EntryCount() for port in self._tables}
        self._entries: list[tuple[EntryConfig, Crossing]] = []
        self._turns: list[HostTurn] = []
        self._hosts: dict[str, memoryview] = {}
        self._before: dict[str, bytes] = {}
        self._statuses: Replayed | None = None

    @classmethod
    def made_ports(cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]) -> MadePorts:
        """Return a port to read and one to write for each entry, and the status."""
        entries = AdapterParams.entries_of(params)
        known = {port: entry for port, entry in entries.items() if entry.source in types}
        inputs = {
            port: Input(types.get(entry.source, AdapterEntry), entry.source)
            for port, entry in entries.items()
        }
        # A message that is passed once must not be sampled; to host boards a bridge writes by
        # itself.
        outputs = {
            port: (QueuedOutput if entry.asynchronous else Output)(
                types[entry.source], rests_on=inputs[port]
            )
            for port, entry in known.items()
        }
        is_whole = bool(entries) and known == entries
        return MadePorts(inputs, {**outputs, STATUS: Output(status_of(entries))}, is_whole)

    @classmethod
    def replayed(cls, params: Mapping[str, Any], layout: Layout) -> Mapping[str, bool]:
        """Return the ports of what host boards send, and the status."""
        hosts = {host.name for host in layout.hosts}
        sent = {
            port: entry.asynchronous
            for port, entry in AdapterParams.entries_of(params).items()
            if layout.mailbox(entry.source).writer in hosts
        }
        return {**sent, STATUS: False}

    def attach(self, segment: Segment, entries: Entries | None) -> None:
        """Open the host side; in a replay, take over what the recorded run wrote, by port,
        instead.
        """
        layout = segment.layout
        hosts = {host.name for host in layout.hosts}
        board = self.context.board
        # What the process before this one has written, if the bridge is restarted.
        status, tick = last_written(segment, f"{board}.{STATUS}")
        for port, table in self._tables.items():
            count = self._counts[port]
            if status is not None:
                count.resume(getattr(status, port), tick)
            own = f"{board}.{port}"
            before, since = last_written(segment, own)
            writer = layout.mailbox(table.source).writer
            entry: Crossing
            if writer not in hosts:
                entry = Outward(segment, own, port, table, count)
            else:
                if before is not None:
                    self._before[port] = bytes(before.raw)
                if entries is None:
                    self._hosts[writer] = segment.block(writer)
                    entry = Inward(segment, port, table, count)
                else:
                    entry = Replayed(entries[port], port, table.asynchronous, since)
            self._entries.append((table, entry))
        if segment.words[System.LOCKSTEP] and entries is None:
            self._turns = [
                HostTurn(segment, host) for host in layout.hosts if board in layout.pacers(host)
            ]
        if entries is not None:
            self._statuses = Replayed(entries[STATUS], STATUS, is_sent=False)

    def process(self, tick: int) -> None:
        """Exchange the entries that are due; then, in lockstep, let programs run."""
        for port, message in self._before.items():
            out = self.ports[port]
            (out.message if isinstance(out, Sender) else out).raw[:] = message
        self._before.clear()
        cycle = (tick - self.context.phase) // self.context.every
        for table, entry in self._entries:
            if table.is_due(cycle):
                entry.exchange(self.readings, self.ports, tick)
        for turn in self._turns:
            turn.take(tick)
        if self._statuses is not None:
            self._statuses.exchange(self.readings, self.ports, tick)
        else:
            self._report(self.ports[STATUS], tick)

    def _report(self, status: Status, tick: int) -> None:
        for port, count in self._counts.items():
            count.fill(getattr(status, port), tick)
        states = {name: block[Block.STATE] for name, block in self._hosts.items()}
        lost = [name for name, block in self._hosts.items() if block[Block.LOST]]
        gone = [name for name, state in states.items() if state == TaskState.GIVEN_UP]
        status.state = State.EXECUTING
        status.error = 0
        status.reason = ""
        if lost:
            # First: in lockstep the Rack may give it up at any tick, and the clock confirms that at
            # one.
            status.state = State.HOLDING
            status.reason = f"host board '{lost[0]}' is lost: it is being restarted"
        elif gone:
            status.state = State.ERROR
            status.reason = f"host board '{gone[0]}' was given up"
        elif states and all(state == TaskState.ENDED for state in states.values()):
            status.state = State.DONE


class HostTurn(ReleasedTask):
    """A host board's program in lockstep, as its adapter sees it; its own end is
    `rack.boards.host.bus.HostBus`.
    """

    def __init__(self, segment: Segment, host: TaskSpec) -> None:
        super().__init__(segment, host)
        self._segment = segment

    def take(self, tick: int) -> None:
        """Let the program run in the cycle released at `tick` if it is due, and wait until it
        waits.

        Raises `CannotGoOn` if that takes too long.
        """
        block = self.block
        # It may be done, or given up.
        if (
            block[Block.STATE] > TaskState.RUNNING
            or block[Block.WAITS_UNTIL] > tick
            or not self.is_free(tick)
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
                    " s of real time: lockstep cannot go on without it"
                )
        if block[Block.LOST]:
            # The crate has noted the tick of the clock, which may be ahead of this cycle.
            block[Block.LOST] = tick + 1


def status_of(entries: Mapping[str, EntryConfig]) -> type[Status]:
    """Return the class of a bridge's status: one group of counts for each entry."""
    groups = {port: field(AdapterEntry, doc=f"entry {port}") for port in entries}
    return make_message("adapter_status", 1, Status, groups)

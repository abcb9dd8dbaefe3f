"""The entries of a bridge: what each passes, in which direction, when, and what is counted of
it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from pydantic import Field as Key
from pydantic import ValidationError, model_validator

from rack.backplane.mailbox.host_ring import HostReader
from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.mailbox.protocols import open_observer, open_writer
from rack.backplane.message import AnyMessage, Message, field, fill_counts
from rack.backplane.segment import Segment
from rack.backplane.semaphores import wake_semaphore
from rack.backplane.words import Block
from rack.boards.wiring import Rows
from rack.levels.tables import LAST_TICK, Table

NEVER = -1
PORT = re.compile(r"[a-z][a-z0-9_]*")
RESERVED = ("status", "echo", "state", "error", "reason", "raw", "record", "clear", "copy_from")
"""Names that the status of a bridge needs for itself."""


def counter(doc: str) -> Any:
    """Declare a counter in the status of an adapter."""
    return field("u4", unit="1", doc=doc)


class AdapterEntry(Message, version=1):
    """One entry, in the status of its bridge."""

    passed: int = counter("messages passed to the other side")
    refused: int = counter("messages refused: damaged, forged, or not what its type permits")
    superseded: int = counter("messages that a newer one overtook before the exchange")
    full: int = counter("messages that the host board could not send, since too many waited")
    waiting: int = counter("messages that wait for the next cycles")
    arrived: int = field(
        unit="tick", doc="tick at which the newest message reached the other side; -1: none yet"
    )
    age: int = field(unit="tick", doc="time since that message was written; -1: none yet")


_COUNTED = ("passed", "refused", "superseded", "full", "waiting", "arrived")


class EntryConfig(Table):
    """`[board.<name>.params.pass.<port>]`: one mailbox that a bus adapter passes across."""

    source: str = Key(alias="from")
    """mailbox to pass, as in program.requests; its side is the direction"""
    every: int = Key(1, ge=1, le=LAST_TICK)
    """exchange in every n-th cycle of the bridge [cycles]"""
    phase: int = Key(0, ge=0)
    """with every: which of the n cycles [cycles]"""
    asynchronous: bool = False
    """pass each message as it comes, once; default: the newest, repeatedly"""
    most: int = Key(8, ge=1, le=256)
    """messages of a host board looked at in one cycle; the others wait"""

    @model_validator(mode="after")
    def _has_one_mode(self) -> Self:
        if self.phase >= self.every:
            raise ValueError(f"phase = {self.phase}: must be less than every, {self.every}")
        if self.asynchronous and self.every > 1:
            raise ValueError(
                f"every = {self.every}: the entry is asynchronous; permitted: one of the two"
            )
        return self

    def is_due(self, cycle: int) -> bool:
        """Say whether the entry is exchanged in that cycle of the bridge."""
        return cycle % self.every == self.phase


class AdapterParams(Table):
    """`[board.<name>.params]` of a bus adapter."""

    entries: dict[str, EntryConfig] = Key({}, alias="pass")
    """mailboxes to pass, by port of the bridge"""

    @model_validator(mode="after")
    def _has_ports(self) -> Self:
        if wrong := [port for port in self.entries if not PORT.fullmatch(port) or port in RESERVED]:
            raise ValueError(
                f"pass.{wrong[0]}: invalid name; permitted: a-z, 0-9 and _, except"
                f" {', '.join(RESERVED)}"
            )
        return self

    @classmethod
    def entries_of(cls, params: Mapping[str, Any]) -> dict[str, EntryConfig]:
        """Return the entries in a table; none if it has mistakes."""
        try:
            return cls.model_validate(params).entries
        except ValidationError:
            return {}


@dataclass
class EntryCount:
    """The counts of one entry: the fields of `AdapterEntry`. `written`: tick at which the newest
    message was written.
    """

    passed: int = 0
    refused: int = 0
    superseded: int = 0
    full: int = 0
    waiting: int = 0
    arrived: int = NEVER
    written: int = NEVER

    def resume(self, record: Any, tick: int) -> None:
        """Continue with the counts in the status of an earlier cycle."""
        age = int(record["age"])
        for name in _COUNTED:
            setattr(self, name, int(record[name]))
        self.written = NEVER if age == NEVER else tick - age

    def passes(self, tick: int, written: int) -> None:
        """Count a message that reaches the other side at `tick`."""
        self.passed += 1
        self.arrived = tick
        self.written = written

    def fill(self, record: Any, tick: int) -> None:
        """Write the counts into the status of a cycle."""
        age = NEVER if self.written == NEVER else tick - self.written
        fill_counts(record, (*(getattr(self, name) for name in _COUNTED), age))


class Inward:
    """Into real time: from the ring of a host board to the bridge's own mailbox, which levels read
    by ticks.
    """

    def __init__(self, segment: Segment, port: str, table: EntryConfig, count: EntryCount) -> None:
        self._ring = HostReader(segment, table.source)
        self._port = port
        self._table = table
        self._count = count
        self._ring.refused = count.refused
        self._ring.superseded = count.superseded
        self._writer = segment.block(self._ring.spec.writer)

    def exchange(
        self, read: Mapping[str, Reading[AnyMessage]], write: Mapping[str, Any], tick: int
    ) -> None:
        """Take what waits, and check it. In lockstep what a program sends is there once its
        computing is over.
        """
        ring = self._ring
        count = self._count
        out = write[self._port]
        waiting = ring.waiting if self._writer[Block.DEADLINE] <= tick else 0
        if self._table.asynchronous:
            for _ in range(min(waiting, self._table.most, out.room())):
                if (message := ring.take()) is not None:
                    out.message.copy_from(message)
                    out.send()
                    count.passes(tick, ring.written)
        elif waiting and (message := ring.take_newest(self._table.most)) is not None:
            out.copy_from(message)
            count.passes(tick, ring.written)
        count.refused = ring.refused
        count.superseded = ring.superseded
        count.full = ring.full
        count.waiting = ring.waiting


class Outward:
    """Out of real time: from a level's mailbox, read by ticks, to one that host boards read; it
    wakes them.
    """

    def __init__(
        self, segment: Segment, own: str, port: str, table: EntryConfig, count: EntryCount
    ) -> None:
        self._writer = open_writer(segment, own)
        self._port = port
        self._table = table
        self._count = count
        self._source = open_observer(segment, table.source)
        readers = self._writer.spec.readers
        self._readers = [(segment.block(name), wake_semaphore(segment, name)) for name in readers]

    def exchange(
        self, read: Mapping[str, Reading[AnyMessage]], write: Mapping[str, Any], tick: int
    ) -> None:
        """Copy what is there."""
        reading = read[self._port]
        if not reading.is_there or (self._table.asynchronous and not reading.is_new):
            return
        for message in (*reading.earlier, reading.message):
            self._writer.message.copy_from(message)
            self._writer.write(tick)
        # A reading does not say when its message was written.
        self._source.read(tick)
        self._count.passes(tick, self._source.newest)
        for block, semaphore in self._readers:
            # In lockstep its program is due.
            block[Block.WAITS_UNTIL] = 0
            # One post is enough: a host board that does not wait would let the semaphore overflow.
            if not semaphore.value:
                semaphore.release()


def last_written(segment: Segment, mailbox: str) -> tuple[AnyMessage | None, int]:
    """Return the newest message of a mailbox, with the tick at which it was written; None and
    `NEVER` if there is none.
    """
    own = open_observer(segment, mailbox)
    reading = own.peek()
    return (reading.message, own.newest) if reading.is_there else (None, NEVER)


class Replayed:
    """A mailbox of an adapter in a replay: what the recorded run wrote to it, at the same ticks.

    Of messages that are sent one by one (`is_sent`), an adapter that was restarted gives out those
    after tick `since`.
    """

    def __init__(self, rows: Rows, port: str, is_sent: bool, since: int = NEVER) -> None:
        self._rows = rows
        self._port = port
        self._is_sent = is_sent
        self._at = sum(tick <= since for tick, _, _ in rows) if is_sent else 0

    def exchange(
        self, read: Mapping[str, Reading[AnyMessage]], write: Mapping[str, Any], tick: int
    ) -> bool:
        """Give out what the recorded run wrote up to this cycle; return whether there was some."""
        out = write[self._port]
        message = out.message if self._is_sent else out
        rows = self._rows
        before = self._at
        while self._at < len(rows) and rows[self._at][0] <= tick:
            _, basis, content = rows[self._at]
            message.raw[:] = content
            self._at += 1
            if self._is_sent:
                out.send(basis)
        return self._at > before


Crossing = Inward | Outward | Replayed
"""One entry, at work: `exchange` is called in the cycles in which that is due."""

"""Entries of a bus adapter: which mailbox each passes, in which direction, and its counters."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Self, TypeVar

import numpy as np
from pydantic import Field as Key
from pydantic import ValidationError, model_validator

from rack.backplane.mailbox.host_ring import HostReader
from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.mailbox.protocols import open_observer, open_writer
from rack.backplane.message import AnyMessage, Message, field, fill_counts, integer_field
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_wake_semaphore
from rack.backplane.words import Block
from rack.boards.wiring import MessageRows
from rack.levels.tables import LAST_TICK, Table

C = TypeVar("C", bound=Message)
NEVER = -1
"""Value in place of a tick for something that has not happened yet."""
PORT = re.compile(r"[a-z][a-z0-9_]*")
RESERVED = ("status", "echo", "state", "error", "reason", "raw", "record", "clear", "copy_from")
"""Names that no port may have, because the status of an adapter has fields of these names."""


def zero_counts(group: type[C]) -> C:
    """Return a group of counters with all values 0.

    Its integers are 64 bits wide, so that they cannot overflow before `fill_counts` limits them to
    the width of the status.
    """
    fields = group.message_type.fields
    return group(np.dtype([(f.name, "f8" if f.python is float else "i8") for f in fields]))


class AdapterEntry(Message, version=1):
    """Counters of one entry, as a group of fields in the status of its adapter."""

    passed: int = integer_field("messages passed to the other side")
    refused: int = integer_field("messages refused: damaged, forged, or not what its type permits")
    superseded: int = integer_field("messages that a newer one overtook before the exchange")
    full: int = integer_field("messages that the host board could not send, since too many waited")
    waiting: int = integer_field("messages that wait for the next cycles")
    arrived: int = field(
        unit="tick", doc="tick at which the newest message reached the other side (-1: none yet)"
    )
    age: int = field(unit="tick", doc="time since that message was written (-1: none yet)")


class EntryConfig(Table):
    """`[board.<name>.params.pass.<port>]`: mailbox that a bus adapter copies to the other side."""

    source: str = Key(alias="from")
    """mailbox to pass, as in program.requests; its side determines the direction"""
    every: int = Key(1, ge=1, le=LAST_TICK)
    """the adapter passes messages in every n-th of its cycles [cycles]"""
    phase: int = Key(0, ge=0)
    """number of the first such cycle, less than every [cycles]"""
    asynchronous: bool = False
    """pass each message once, in order; default: pass the newest message in each exchange"""
    most: int = Key(8, ge=1, le=256)
    """largest number of messages of a host board that one cycle processes; further ones wait"""

    @model_validator(mode="after")
    def _check_phase_and_every(self) -> Self:
        """Check that `phase` is less than `every`, which must be 1 for asynchronous entries."""
        if self.phase >= self.every:
            raise ValueError(f"phase = {self.phase}: must be less than every, {self.every}")
        if self.asynchronous and self.every > 1:
            raise ValueError(
                f"every = {self.every}: the entry is also asynchronous; give only one of the two"
            )
        return self

    def is_due(self, cycle: int) -> bool:
        """Return True if the adapter passes messages of this entry in cycle number `cycle`."""
        return cycle % self.every == self.phase


class AdapterParams(Table):
    """`[board.<name>.params]`: parameters of a bus adapter."""

    entries: dict[str, EntryConfig] = Key({}, alias="pass")
    """mailboxes to pass, by port of the adapter"""

    @model_validator(mode="after")
    def _check_port_names(self) -> Self:
        """Check that names of ports are valid and are not reserved for fields of the status."""
        for port in self.entries:
            if not PORT.fullmatch(port) or port in RESERVED:
                why = f"valid: a-z, 0-9 and _, except {', '.join(RESERVED)}"
                raise ValueError(f"pass.{port}: invalid name; {why}")
        return self

    @classmethod
    def read_entries(cls, params: Mapping[str, Any]) -> dict[str, EntryConfig]:
        """Return a parameter table's entries, keyed by port. Empty if the table has mistakes."""
        try:
            return cls.model_validate(params).entries
        except ValidationError:
            return {}


class EntryCounters:
    """Counters of one entry.

    Attributes:
        count: The counters, as in the status.
        written: Tick at which the newest message was written. `NEVER` before the first.
    """

    def __init__(self) -> None:
        self.count = zero_counts(AdapterEntry)
        self.count.arrived = self.written = NEVER

    def restore_counts(self, record: Any, tick: int) -> None:
        """Restore the counters from the last status before a restart.

        Args:
            record: The entry's group of fields in that status.
            tick: Tick at which the status was written.
        """
        self.count.record[...] = record
        self.written = NEVER if self.count.age == NEVER else tick - self.count.age

    def count_passed(self, tick: int, written: int) -> None:
        """Count a message that was written at `written` and reaches the other side at `tick`."""
        self.count.passed += 1
        self.count.arrived = tick
        self.written = written

    def write_counts(self, record: Any, tick: int) -> None:
        """Write the counters to the entry's group of fields in the status of a cycle."""
        self.count.age = NEVER if self.written == NEVER else tick - self.written
        fill_counts(record, self.count.record.item())


class InwardEntry:
    """Entry that passes messages from the ring of a host board to a mailbox that levels read.

    Args:
        segment: Segment of the rack.
        port: Port of the adapter.
        table: Table of the entry.
        count: Its counters.
    """

    def __init__(
        self, segment: Segment, port: str, table: EntryConfig, count: EntryCounters
    ) -> None:
        self._ring = HostReader(segment, table.source)
        self._port = port
        self._table = table
        self._count = count
        self._ring.refused = count.count.refused
        self._ring.superseded = count.count.superseded
        self._writer = segment.get_block(self._ring.spec.writer)

    def exchange_messages(
        self, read: Mapping[str, Reading[AnyMessage]], write: Mapping[str, Any], tick: int
    ) -> None:
        """Take waiting messages from the ring and pass the valid ones on.

        In lockstep, messages of a program wait until its computing time has passed.

        Args:
            read: Readings of the adapter's inputs, by port. Not used.
            write: Output messages of the adapter, by port.
            tick: Tick at which the cycle was released.
        """
        ring = self._ring
        count = self._count
        out = write[self._port]
        waiting = ring.waiting_count if self._writer[Block.DEADLINE] <= tick else 0
        if self._table.asynchronous:
            for _ in range(min(waiting, self._table.most, out.room())):
                if (message := ring.take_oldest()) is not None:
                    out.message.copy_from(message)
                    out.send()
                    count.count_passed(tick, ring.written_tick)
        elif waiting and (message := ring.take_newest(self._table.most)) is not None:
            out.copy_from(message)
            count.count_passed(tick, ring.written_tick)
        counts = count.count
        counts.refused = ring.refused
        counts.superseded = ring.superseded
        counts.full = ring.full_count
        counts.waiting = ring.waiting_count


class OutwardEntry:
    """Entry that passes messages of a level to a mailbox that host boards read.

    Args:
        segment: Segment of the rack.
        mailbox: Mailbox that the adapter writes.
        port: Port of the adapter.
        table: Table of the entry.
        count: Its counters.
    """

    def __init__(
        self, segment: Segment, mailbox: str, port: str, table: EntryConfig, count: EntryCounters
    ) -> None:
        self._writer = open_writer(segment, mailbox)
        self._port = port
        self._table = table
        self._count = count
        self._source = open_observer(segment, table.source)
        readers = self._writer.spec.readers
        self._readers = [
            (segment.get_block(name), get_wake_semaphore(segment, name)) for name in readers
        ]

    def exchange_messages(
        self, read: Mapping[str, Reading[AnyMessage]], write: Mapping[str, Any], tick: int
    ) -> None:
        """Copy the messages that the adapter has read, and wake the host boards that read them.

        An asynchronous entry copies only new messages. Other entries repeat the newest one.

        Args:
            read: Readings of the adapter's inputs, by port.
            write: Output messages of the adapter, by port. Not used.
            tick: Tick at which the cycle was released.
        """
        reading = read[self._port]
        if not reading.has_message or (self._table.asynchronous and not reading.is_new):
            return
        for message in (*reading.earlier, reading.message):
            self._writer.message.copy_from(message)
            self._writer.write(tick)
        # The reading does not contain the tick at which its message was written, so get it from the
        # mailbox.
        self._source.read(tick)
        self._count.count_passed(tick, self._source.newest)
        for block, semaphore in self._readers:
            # In lockstep this makes the program due for a turn.
            block[Block.WAITS_UNTIL] = 0
            # Post only if no post is pending, or the semaphore of a host board that never waits
            # would overflow.
            if not semaphore.value:
                semaphore.release()


def read_last_written(segment: Segment, mailbox: str) -> tuple[AnyMessage | None, int]:
    """Return the newest message of a mailbox and the tick at which it was written.

    Returns:
        The message and the tick, or None and `NEVER` if the mailbox is empty.
    """
    observer = open_observer(segment, mailbox)
    reading = observer.peek()
    return (reading.message, observer.newest) if reading.has_message else (None, NEVER)


class ReplayedEntry:
    """Entry in a replay, which writes the messages of the recorded run at the same ticks.

    Args:
        rows: Recorded messages. See `rack.boards.wiring.MessageRows`.
        port: Port of the adapter.
        is_sent: Whether each message must be sent exactly once and in order.
        since: Tick up to which messages were sent before the adapter was restarted. `NEVER` if it
            was not.
    """

    def __init__(self, rows: MessageRows, port: str, is_sent: bool, since: int = NEVER) -> None:
        self._rows = rows
        self._port = port
        self._is_sent = is_sent
        self._at = sum(tick <= since for tick, _, _ in rows) if is_sent else 0

    def exchange_messages(
        self, read: Mapping[str, Reading[AnyMessage]], write: Mapping[str, Any], tick: int
    ) -> bool:
        """Write the recorded messages that are due in this cycle.

        Args:
            read: Readings of the adapter's inputs, by port. Not used.
            write: Output messages of the adapter, by port.
            tick: Tick at which the cycle was released.

        Returns:
            True if at least one message was written.
        """
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


ActiveEntry = InwardEntry | OutwardEntry | ReplayedEntry
"""An entry in operation. Its `exchange_messages` is called in cycles in which the entry is due."""

"""The mailboxes of one step of the cycle as a table for machine code: reads of plan, or of commands
and statuses; writes.

Python looks at the ports alone whose reading has changed, and reads and writes those of other
protocols itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import NamedTuple

import numpy as np

from rack.backplane.address_map import slot_stride
from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.interrupt import InterruptWriter
from rack.backplane.mailbox.mailbox import DoubleBufferReader, DoubleBufferWriter, Reader, Writer
from rack.backplane.mailbox.slots import Slots
from rack.backplane.message import AnyMessage
from rack.backplane.watch.watched_reader import SporadicReader, Watched, WatchedReader
from rack.backplane.words import Block
from rack.boards.run.compiled_mailbox import (
    MOST_PORTS,
    NEW,
    ODD,
    READ_PORT,
    SILENT,
    SLOW,
    WRITE_PORT,
    read_ports,
    write_ports,
)
from rack.levels.level import Reading

WORD = 8
"""Bytes of a word, and the alignment of all memory that is accessed by address."""


class Line(NamedTuple):
    """One mailbox to read: where its reading goes, the function that reads it as of a tick, and the
    reader behind that.
    """

    values: dict[str, Reading[AnyMessage]]
    key: str
    read: Callable[[int], Reading[AnyMessage]]
    watched: Watched


class ReadTable:
    """The reads of one step. Machine code makes those that it can."""

    def __init__(self, lines: Sequence[Line]) -> None:
        self._lines = [line for line in lines if can_read(line)][:MOST_PORTS]
        self._others = [line for line in lines if line not in self._lines]
        self._ports = np.zeros(len(self._lines), READ_PORT)
        for port, line in zip(self._ports, self._lines, strict=True):
            _fill_read_port(port, line.watched)
        self._read_ports = read_ports.load() if self._lines else lambda *_: 0
        self._address = self._ports.ctypes.data
        self._count = len(self._lines)

    def read(self, tick: int) -> None:
        """Read every mailbox as of `tick`."""
        touched = self._read_ports(self._address, self._count, tick)
        if touched:
            for at, line in enumerate(self._lines):
                if touched >> at & 1:
                    result = int(self._ports["result"][at])
                    line.values[line.key] = _conclude(line, result, tick)
        for line in self._others:
            line.values[line.key] = line.read(tick)


def can_read(line: Line) -> bool:
    """Whether machine code can read a mailbox: at every tick, without a lock."""
    watched = line.watched
    return (
        line.read == watched.read
        and type(watched) in (WatchedReader, SporadicReader)
        and type(watched.reader) in (Reader, DoubleBufferReader)
    )


def _conclude(line: Line, result: int, tick: int) -> Reading[AnyMessage]:
    watched = line.watched
    if result & SLOW:
        return line.read(tick)
    reading = watched.reader.reading(bool(result & NEW))
    if not isinstance(watched, WatchedReader):
        return reading
    is_odd, is_silent = bool(result & ODD), bool(result & SILENT)
    return watched.conclude(tick, reading, is_odd=is_odd, is_silent=is_silent)


def _fill_read_port(port: np.void, watched: Watched) -> None:
    reader = watched.reader
    _fill_slots(port, reader.slots)
    port["state"] = address_of(reader.words)
    port["good"] = address_of(reader.good)
    port["is_sliced"] = type(reader) is Reader
    port["result"] = -1
    if isinstance(watched, WatchedReader):
        port["is_watched"] = True
        port["lost"] = address_of(watched.writer[Block.LOST : Block.LOST + 1])
        port["late_from"] = watched.late_from
        port["quiet"] = watched.quiet


def _fill_slots(port: np.void, slots: Slots) -> None:
    port["head"] = address_of(slots.box)
    port["slots"] = address_of(slots.ring)
    port["record"] = address_of(slots.record)
    port["stride"] = slot_stride(slots.spec)
    port["depth"] = slots.depth
    port["size"] = len(slots.record)


def address_of(memory: memoryview) -> int:
    """Return the address of memory. Raises `MailboxError` when it is not aligned to words."""
    address = int(np.frombuffer(memory, np.uint8).ctypes.data)
    if address % WORD:
        raise MailboxError(
            f"memory at {address:#x} is not aligned to {WORD} bytes: atomic access needs that"
        )
    return address


class WriteTable:
    """The mailboxes that machine code writes."""

    def __init__(self, writers: Sequence[tuple[Writer, Sequence[Reader]]]) -> None:
        """Fill the table.

        Args:
            writers: The writers, for which `can_write` is true, each with the readers that its
                message rests on.
        """
        self._writers = [writer for writer, _ in writers]
        self._ports = np.zeros(len(writers), WRITE_PORT)
        self._sources = [
            np.array([address_of(reader.words) for reader in sources], np.int64)
            for _, sources in writers
        ]
        for port, (writer, _), sources in zip(self._ports, writers, self._sources, strict=True):
            spec = writer.spec
            _fill_slots(port, writer.slots)
            port["sources"] = sources.ctypes.data
            port["source_count"] = len(sources)
            port["every"] = spec.every
            port["ahead"] = spec.ahead - spec.phase
            port["delay"] = writer.visible_at(0, None)
        self._write_ports = write_ports.load() if writers else lambda *_: False
        self._address = self._ports.ctypes.data
        self._count = len(writers)

    def write(self, tick: int) -> bool:
        """Write the messages that are due, in a cycle whose end has not come; say whether a writer
        has an intruder.
        """
        is_intruded: bool = self._write_ports(self._address, self._count, tick, monotonic_ns())
        if is_intruded:
            for writer, port in zip(self._writers, self._ports, strict=True):
                writer.intruder = int(port["intruder"])
        return is_intruded


def can_write(writer: Writer) -> bool:
    """Whether machine code can write a mailbox: once in each of its cycles, without a lock."""
    kinds = Writer, DoubleBufferWriter, InterruptWriter
    return type(writer) in kinds and not writer.spec.max_age

"""The mailboxes of one step of the cycle as a table for machine code: reads of plan, or of commands
and statuses; writes.

Python looks at the ports alone whose reading has changed, and reads and writes those of other
protocols itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    AT_ONCE,
    IN_TIME,
    LATE,
    MOST_PORTS,
    NEW,
    ODD,
    READ_PORT,
    SENT,
    SILENT,
    SLICED,
    SLOW,
    WRITE_PORT,
    read_ports,
    write_ports,
)
from rack.levels.level import Reading

VISIBILITIES = {Writer: SLICED, DoubleBufferWriter: AT_ONCE, InterruptWriter: SENT}
"""When messages are visible, by writers whose messages machine code can write."""
WORD = 8
"""Bytes of a word, and the alignment of all memory that is accessed by address."""


class Line(NamedTuple):
    """One mailbox to read: where its reading goes, the function that reads it as of a tick, and the
    reader behind that."""

    values: dict[str, Reading[AnyMessage]]
    key: str
    read: Callable[[int], Reading[AnyMessage]]
    watched: Watched


class ReadTable:
    """The reads of one step. With `is_compiled`, machine code makes those that it can."""

    def __init__(self, lines: Sequence[Line], is_compiled: bool) -> None:
        self._lines = lines
        compiled = [line for line in lines if is_compiled and _is_simple(line)][:MOST_PORTS]
        # The bit of each line in the answer; lines that Python reads have none.
        self._bits = [1 << compiled.index(line) if line in compiled else 0 for line in lines]
        self._is_mixed = len(compiled) < len(lines)
        self._count = len(compiled)
        self._ports = np.zeros(len(compiled), READ_PORT)
        self._results = self._ports["result"]
        for port, line in zip(self._ports, compiled, strict=True):
            _fill_read_port(port, line.watched)
        self._address = address_of(self._ports.data)
        self._read_ports = read_ports.load() if compiled else lambda *_: 0

    def read(self, tick: int) -> None:
        """Read every mailbox as of `tick`."""
        touched = self._read_ports(self._address, self._count, tick)
        if not touched and not self._is_mixed:
            return
        for line, bit in zip(self._lines, self._bits, strict=True):
            if not bit:
                line.values[line.key] = line.read(tick)
            elif touched & bit:
                result = int(self._results[bit.bit_length() - 1])
                line.values[line.key] = _conclude(line, result, tick)


def _is_simple(line: Line) -> bool:
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
    if not isinstance(watched, WatchedReader):
        return watched.reader.reading(False)
    return watched.conclude(
        tick,
        is_new=bool(result & NEW),
        is_odd=bool(result & ODD),
        is_silent=bool(result & SILENT),
    )


def _fill_read_port(port: np.void, watched: Watched) -> None:
    reader = watched.reader
    _fill_slots(port, reader.slots)
    port["state"] = address_of(reader.words)
    port["good"] = address_of(reader.good)
    port["is_sliced"] = type(reader) is Reader
    port["every"] = reader.spec.every
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
            writers: The writers, whose types `can_write` permits, each with the readers that its
                message rests on.
        """
        self._ports = np.zeros(len(writers), WRITE_PORT)
        self._sources = [
            np.array([address_of(reader.words) for reader in sources], np.int64)
            for _, sources in writers
        ]
        for port, (writer, _), sources in zip(self._ports, writers, self._sources, strict=True):
            _fill_write_port(port, writer)
            port["sources"] = sources.ctypes.data
            port["source_count"] = len(sources)
        self._address = self._ports.ctypes.data
        self._write_ports = write_ports.load() if writers else lambda *_: 0

    def write(self, tick: int, now: int | None) -> tuple[bool, int]:
        """Write the messages that are due, `now` as in `Writer.write`; return whether none was too
        late, and a bit for each port with an intruder."""
        answer = self._write_ports(
            self._address, len(self._ports), tick, IN_TIME if now is None else now
        )
        return answer < LATE, answer & (LATE - 1)

    def enable(self, at: int, is_enabled: bool) -> None:
        """Let machine code write a port, or leave that to Python."""
        self._ports[at]["is_enabled"] = is_enabled

    def intruder(self, at: int) -> int:
        """Return the process of the intruder that the last write has found; 0: none."""
        return int(self._ports[at]["intruder"])


def can_write(writer: Writer) -> bool:
    """Whether machine code can write a mailbox: once in each of its cycles, without a lock."""
    return type(writer) in VISIBILITIES and not writer.spec.max_age


def _fill_write_port(port: np.void, writer: Writer) -> None:
    spec = writer.spec
    _fill_slots(port, writer.slots)
    port["every"] = spec.every
    port["ahead"] = spec.ahead - spec.phase
    port["phase"] = spec.phase
    port["delay"] = spec.delay
    port["due"] = writer.due
    port["visibility"] = VISIBILITIES[type(writer)]
    port["is_enabled"] = True

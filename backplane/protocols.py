"""The three mailbox protocols by name: one writer class and one reader class each, and one reader for all."""

from __future__ import annotations

from rack.backplane.double_buffer import DoubleBufferReader, DoubleBufferWriter
from rack.backplane.layout import Protocol
from rack.backplane.lock import LockReader, LockWriter
from rack.backplane.mailbox import Reader, Writer
from rack.backplane.segment import Segment

WRITERS: dict[Protocol, type[Writer]] = {
    "time-slice": Writer,
    "double-buffer": DoubleBufferWriter,
    "lock": LockWriter,
}
READERS: dict[Protocol, type[Reader]] = {
    "time-slice": Reader,
    "double-buffer": DoubleBufferReader,
    "lock": LockReader,
}


def open_writer(segment: Segment, name: str) -> Writer:
    """Claim a mailbox for writing under its protocol. Raises `MailboxError` when it has a writer."""
    return WRITERS[segment.layout.mailbox(name).protocol](segment, name)


def open_reader(segment: Segment, name: str) -> Reader:
    """Open a mailbox for reading under its protocol."""
    return READERS[segment.layout.mailbox(name).protocol](segment, name)


def open_observer(segment: Segment, name: str) -> Reader:
    """Open a mailbox for reading without ever taking its lock: for the clock and the host side."""
    is_locked = segment.layout.mailbox(name).protocol == "lock"
    return DoubleBufferReader(segment, name) if is_locked else open_reader(segment, name)

"""The mailboxes of one step of the cycle, as a table for compiled code.

The steps are reading the plan, reading commands and statuses, and writing outputs. Compiled
code accesses the mailboxes of a step in one call. Python then handles only the ports whose result
has changed, and accesses the mailboxes whose protocol compiled code does not support.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import monotonic_ns

import numpy as np

from rack.backplane.address_map import compute_slot_stride
from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.mailbox import DoubleBufferReader, Reader, Writer
from rack.backplane.mailbox.slots import Slots, get_pid
from rack.backplane.watch.watched_reader import MailboxWatcher, WatchedReader
from rack.backplane.words import Block
from rack.boards.exchange import InputMailbox
from rack.boards.run.compiled_mailbox import (
    CHECK_MESSAGES,
    CHECK_SILENCE,
    NEW_RESULT,
    PORT,
    READ_IN_PYTHON,
    access_ports,
)

WORD_BYTES = 8
"""Size of a word in bytes, and required alignment of memory that compiled code accesses."""


class PortTable:
    """Table of mailboxes, and the compiled function that accesses all of them in one call."""

    def __init__(self, slots: Sequence[Slots]) -> None:
        self._ports = np.zeros(len(slots), PORT)
        for port, each in zip(self._ports, slots, strict=True):
            port["head"] = get_address(each.box)
            port["slots"] = get_address(each.places[0])
            port["record"] = get_address(each.record)
            port["stride"] = compute_slot_stride(each.spec)
            port["depth"] = each.depth
            port["size"] = len(each.record)
        self._access: Callable[..., bool] = lambda *_: False
        if slots:
            self._access = partial(
                access_ports.load_machine_code(), self._ports.ctypes.data, len(slots)
            )


class ReadTable(PortTable):
    """Table of the mailboxes to read in one step.

    Python reads those that compiled code does not support.
    """

    def __init__(self, lines: Sequence[InputMailbox]) -> None:
        self._compiled = [line for line in lines if can_read(line)]
        self._others = [line for line in lines if not can_read(line)]
        super().__init__([line.watcher.reader.slots for line in self._compiled])
        for port, (_, _, watcher) in zip(self._ports, self._compiled, strict=True):
            port["state"] = get_address(watcher.reader.words)
            port["is_sliced"] = type(watcher.reader) is Reader
            port["result"] = -1
            if isinstance(watcher, WatchedReader):
                port["is_watched"] = True
                port["lost"] = get_address(watcher.watch.block[Block.LOST : Block.LOST + 1])
                port["late_from"] = watcher.watch.late_from
                port["quiet"] = watcher.watch.quiet

    def read(self, tick: int) -> None:
        """Read every mailbox as of `tick`, and store the readings for the level."""
        if self._access(tick, 0):
            results = self._ports["result"].tolist()
            for result, (readings, key, watcher) in zip(results, self._compiled, strict=True):
                if result & READ_IN_PYTHON:
                    readings[key] = watcher.read(tick)
                    continue
                readings[key] = watcher.reader.get_reading(bool(result & NEW_RESULT))
                if result > NEW_RESULT and isinstance(watcher, WatchedReader):
                    readings[key] = watcher.check_reading(
                        tick, readings[key], result & CHECK_MESSAGES, result & CHECK_SILENCE
                    )
        for readings, key, watcher in self._others:
            readings[key] = watcher.read(tick)


def can_read(line: InputMailbox) -> bool:
    """Check whether compiled code can read a mailbox.

    It can if the mailbox is read in every cycle and its protocol has no lock, queue or interrupts.
    """
    kinds = Reader, DoubleBufferReader
    return isinstance(line.watcher, MailboxWatcher) and type(line.watcher.reader) in kinds


def get_address(memory: memoryview) -> int:
    """Return the address at which a block of memory starts.

    Raises:
        MailboxError: The memory is not aligned to words.
    """
    address = int(np.frombuffer(memory, np.uint8).ctypes.data)
    if address % WORD_BYTES:
        raise MailboxError(
            f"memory at {address:#x} is not aligned to {WORD_BYTES} bytes, as atomic "
            "access requires"
        )
    return address


class WriteTable(PortTable):
    """Table of the mailboxes that compiled code writes."""

    def __init__(self, writers: Sequence[tuple[Writer, Sequence[Reader]]]) -> None:
        """Fill the table.

        Args:
            writers: Writers for which `can_write` is true, each with the readers on whose messages
                its own message depends.
        """
        super().__init__([writer.slots for writer, _ in writers])
        self._writers = writers
        self._sources: list[np.ndarray] = []
        for port, (writer, readers) in zip(self._ports, writers, strict=True):
            spec = writer.spec
            sources = np.array([get_address(reader.words) for reader in readers], np.int64)
            self._sources.append(sources)
            port["sources"] = sources.ctypes.data
            port["source_count"] = len(sources)
            port["every"] = spec.every
            port["ahead"] = spec.due_offset
            port["delay"] = writer.compute_visible_tick(0, None)

    def write(self, tick: int) -> bool:
        """Write the messages that are due. Call this only if the cycle is not late.

        Returns:
            True if the `intruder` of any writer may have changed.
        """
        must_handle = self._access(tick, monotonic_ns())
        if must_handle:
            for (writer, _), signature in zip(self._writers, self._ports["result"], strict=True):
                writer.intruder = get_pid(int(signature))
        return must_handle


def can_write(writer: Writer) -> bool:
    """Check whether compiled code can write a mailbox.

    It cannot if the mailbox is written on demand, or its protocol is queue or lock.
    """
    spec = writer.spec
    return spec.protocol not in ("queue", "lock") and not spec.max_age

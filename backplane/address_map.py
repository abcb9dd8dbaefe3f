"""Memory map with the bus address of every board's window, task block and mailbox.

Addresses are byte offsets in the segment. A board's window starts on a page and holds the control
blocks, trace rings and alarm rings of its tasks, followed by the mailboxes that it writes. The
layout alone determines the map.
"""

from __future__ import annotations

from collections.abc import Collection

from rack.backplane.layout import Layout, MailboxSpec

PAGE = 4096
CACHE_LINE = 64
"""Size of a cache line, in bytes. Blocks of different writers never share a cache line."""

HEAD_SIZE = PAGE
BLOCK_SIZE = 6 * CACHE_LINE
TRACE_RECORD_SIZE = 88
ALARM_RECORD_SIZE = 192
ALARM_DEPTH = 256
"""Number of records in an alarm ring.

The ring is read many times a second, and an alarm is raised once per episode.
"""
FAULT_ENTRY_SIZE = 256
FAULT_ENTRIES = 64
OPERATOR_HEAD_SIZE = CACHE_LINE
OPERATOR_ENTRIES = 128
CLOCK = "clock"
"""Name of the system controller, in slot 1.

Its window holds the fault table, the operator table and the operators' mailboxes.
"""
CLOCK_STANDBY = "clock.standby"
"""Name of the process that continues the clock when the first one is lost."""
MAILBOX_HEAD_SIZE = 2 * CACHE_LINE
SLOT_HEAD_SIZE = 64
SCRATCH_SIZE = CACHE_LINE
"""Size of the scratch words of a host board, in bytes."""
ALARM_SIZE = CACHE_LINE + ALARM_DEPTH * ALARM_RECORD_SIZE
"""Bytes of one alarm ring: a cache line for its head, followed by the records."""


class AddressMap:
    """Bus addresses of everything on one backplane.

    Attributes:
        windows: Address of each board's window, by board.
        size: Total size in bytes, without the texts (layout, config, published facts) that follow
            it in the segment.
    """

    def __init__(self, layout: Layout) -> None:
        self.blocks: dict[str, int] = {}
        self.traces: dict[str, int] = {}
        self.mailboxes: dict[str, int] = {}
        self.windows = {CLOCK: HEAD_SIZE}
        self._end = HEAD_SIZE
        self.faults = self._reserve(FAULT_ENTRIES * FAULT_ENTRY_SIZE)
        self.operator = self._reserve(OPERATOR_ENTRIES * compute_operator_entry_size(layout))
        self.alarms = {CLOCK: self._reserve(ALARM_SIZE)}
        self._end_window({CLOCK}, layout)
        for board in dict.fromkeys(task.board for task in layout.processes):
            self.windows[board] = self._end
            tasks = {task.name: task for task in layout.processes if task.board == board}
            for name, task in tasks.items():
                self.blocks[name] = self._reserve(BLOCK_SIZE)
                self.traces[name] = self._reserve(task.depth * TRACE_RECORD_SIZE)
                self.alarms[name] = self._reserve(ALARM_SIZE)
            self._end_window(tasks, layout)
        # Semaphores follow the windows, each in a separate cache line.
        self.wake = {task.name: self._reserve(CACHE_LINE) for task in layout.processes}
        self.done = {task.name: self._reserve(CACHE_LINE) for task in layout.processes}
        self.locks = {
            box.name: self._reserve(CACHE_LINE)
            for box in layout.mailboxes
            if box.protocol == "lock"
        }
        self.scratch = {host.name: self._reserve(SCRATCH_SIZE) for host in layout.hosts}
        self.size = round_up_to_pages(self._end)

    def describe_owner(self, address: int) -> str:
        """Return a description of what contains an address on the bus, with its writer."""
        places = {
            0: "the words of the Rack, the system clock and its tables",
            **{
                at: f"the control block of '{name}' and its rings"
                for name, at in self.blocks.items()
            },
            **{
                at: f"mailbox '{name}', whose messages have checksums and one writer"
                for name, at in self.mailboxes.items()
            },
            **dict.fromkeys(self.wake.values(), "semaphores and locks"),
            **{at: f"the scratch words of '{name}'" for name, at in self.scratch.items()},
        }
        return places[max(start for start in places if start <= address)]

    def _reserve(self, size: int) -> int:
        """Reserve `size` bytes, starting on a new cache line, and return their address."""
        address = self._end
        self._end = _round_up(address + size, CACHE_LINE)
        return address

    def _end_window(self, writers: Collection[str], layout: Layout) -> None:
        """Reserve memory for the mailboxes of a board's tasks, and end its window on a page."""
        for mailbox in layout.mailboxes:
            if mailbox.writer in writers:
                self.mailboxes[mailbox.name] = self._reserve(
                    MAILBOX_HEAD_SIZE + mailbox.depth * compute_slot_stride(mailbox)
                )
        self._end = round_up_to_pages(self._end)


def round_up_to_pages(size: int) -> int:
    """Return a size in bytes, rounded up to whole pages."""
    return _round_up(size, PAGE)


def compute_slot_stride(mailbox: MailboxSpec) -> int:
    """Return the distance from one slot of a mailbox to the next, in bytes."""
    return _round_up(SLOT_HEAD_SIZE + mailbox.size, CACHE_LINE)


def compute_oldest_intact(head: int, depth: int) -> int:
    """Return the number of the oldest record in a ring that the writer cannot be overwriting.

    The writer works at most one record ahead of `head`. A concurrent reader therefore copies a
    record first, loads `head` afterwards, and discards the copy if the record's number is lower
    than the result, because part of the copy may come from a newer record.

    Args:
        head: Number of records written.
        depth: Number of records in the ring.
    """
    return head + 2 - depth


def compute_operator_entry_size(layout: Layout) -> int:
    """Return the size of an operator table entry with room for the largest message, in bytes."""
    return OPERATOR_HEAD_SIZE + _round_up(
        max((m.size for m in layout.mailboxes if m.writer == CLOCK), default=0), CACHE_LINE
    )


def _round_up(value: int, step: int) -> int:
    """Round `value` up to a multiple of `step`."""
    return -(-value // step) * step

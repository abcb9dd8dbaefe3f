"""What a config makes: tasks in their slots, mailboxes at their bus addresses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from rack.backplane.address_map import AddressMap
from rack.backplane.layout import Layout, MailboxSpec
from rack.boards.config.schema import CLOCK_SLOT, RackConfig
from rack.tools.console.tables import table


@dataclass(frozen=True)
class TaskEntry:
    """One task: where it runs, how often, and how long after its release its messages are visible."""

    slot: int
    task: str
    core: int
    priority: int
    rate_hz: float
    every_ticks: int
    slice_ms: float
    trace_address: int


@dataclass(frozen=True)
class MailboxEntry:
    """One mailbox on the bus. `depth` is the number of its slots, `size` the bytes of one message."""

    address: int
    mailbox: str
    message: str
    size: int
    depth: int
    protocol: str
    writer: str
    readers: tuple[str, ...]
    delay_ms: float


@dataclass(frozen=True)
class Inventory:
    """What stands in the crate and what lies on the bus."""

    rack: str
    mode: str
    clock_ms: float
    clock_core: int
    clock_priority: int
    segment_bytes: int
    windows: dict[str, int]
    tasks: tuple[TaskEntry, ...]
    mailboxes: tuple[MailboxEntry, ...]
    notes: tuple[str, ...]

    @classmethod
    def of(cls, config: RackConfig, layout: Layout, notes: list[str]) -> Inventory:
        """Return the inventory of a config and its layout."""
        places, tick_ms = AddressMap(layout), layout.clock_ns * 1e-6
        tasks = (
            TaskEntry(
                slot=task.slot,
                task=task.name,
                core=task.core,
                priority=task.priority,
                rate_hz=1e9 / (task.every * layout.clock_ns),
                every_ticks=task.every,
                slice_ms=task.every * task.within_cycles * tick_ms,
                trace_address=places.traces[task.name],
            )
            for task in sorted(layout.tasks, key=lambda t: (t.slot, t.role))
        )
        return cls(
            rack=config.name,
            mode=config.clock.mode,
            clock_ms=tick_ms,
            clock_core=config.clock.core,
            clock_priority=config.clock.priority,
            segment_bytes=places.size,
            windows={window.board: window.address for window in places.windows},
            tasks=tuple(tasks),
            mailboxes=tuple(_entry(m, places, tick_ms) for m in layout.mailboxes),
            notes=tuple(notes),
        )

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return asdict(self)

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield everything that fits into `width` as text for people."""
        boards = len({task.slot for task in self.tasks})
        yield f"rack {self.rack}: {boards} board{'s' * (boards > 1)} and the clock, {self.clock_ms:g} ms, {self.mode}"
        yield from self.notes
        clock = [str(CLOCK_SLOT), "clock", str(self.clock_core), str(self.clock_priority or "-"), "", "", "", ""]
        yield ""
        yield from table(
            ["slot", "task", "core", "FIFO", "rate, Hz", "ticks", "slice, ms", "trace at"],
            [clock, *(_task_row(task) for task in self.tasks)],
            width,
            ("trace at", "slice, ms"),
        )
        yield ""
        yield from table(
            ["bus address", "mailbox", "message", "bytes", "slots", "protocol", "delay, ms", "written by > read by"],
            [_mailbox_row(mailbox) for mailbox in self.mailboxes],
            width,
            ("slots", "bytes", "message", "protocol"),
        )
        yield ""
        yield f"segment: {self.segment_bytes} bytes; board windows: {_windows(self.windows)}"


def _entry(mailbox: MailboxSpec, places: AddressMap, tick_ms: float) -> MailboxEntry:
    return MailboxEntry(
        address=places.mailboxes[mailbox.name],
        mailbox=mailbox.name,
        message=f"{mailbox.message} {mailbox.version}",
        size=mailbox.size,
        depth=mailbox.depth,
        protocol=mailbox.protocol,
        writer=mailbox.writer,
        readers=mailbox.readers,
        delay_ms=mailbox.delay * tick_ms,
    )


def _task_row(task: TaskEntry) -> list[str]:
    rate, ticks, slice_ms = f"{task.rate_hz:g}", str(task.every_ticks), f"{task.slice_ms:g}"
    priority = str(task.priority or "-")
    return [str(task.slot), task.task, str(task.core), priority, rate, ticks, slice_ms, f"0x{task.trace_address:06x}"]


def _mailbox_row(mailbox: MailboxEntry) -> list[str]:
    ways = f"{mailbox.writer} > {', '.join(mailbox.readers) or '(nobody)'}"
    counts = [str(mailbox.size), str(mailbox.depth), mailbox.protocol, f"{mailbox.delay_ms:g}"]
    return [f"0x{mailbox.address:06x}", mailbox.mailbox, mailbox.message, *counts, ways]


def _windows(windows: dict[str, int]) -> str:
    return ", ".join(f"{board} 0x{address:06x}" for board, address in windows.items())

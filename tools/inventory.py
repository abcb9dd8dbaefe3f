"""The inventory of a rack: tasks in their slots, mailboxes at their bus addresses; as plain data and as text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rack.backplane.address_map import AddressMap
from rack.backplane.layout import Layout
from rack.boards.config.schema import CLOCK_SLOT, RackConfig
from rack.tools.text_table import table

Document = dict[str, Any]


def inventory(config: RackConfig, layout: Layout, notes: list[str]) -> Document:
    """Return the inventory of a config as plain data; addresses and sizes in bytes.

    Of a task `slice_ms` is the time from its release until its messages are visible, of a mailbox `delay_ms` the same;
    `depth` is the number of a mailbox's slots, `size` the bytes of one message.
    """
    places, tick_ms = AddressMap(layout), layout.clock_ns * 1e-6
    tasks = [
        {
            "slot": task.slot,
            "task": task.name,
            "core": task.core,
            "priority": task.priority,
            "rate_hz": 1e9 / (task.every * layout.clock_ns),
            "every_ticks": task.every,
            "slice_ms": task.every * task.within_cycles * tick_ms,
            "trace_address": places.traces[task.name],
        }
        for task in sorted(layout.tasks, key=lambda t: (t.slot, t.role))
    ]
    mailboxes = [
        {
            "address": places.mailboxes[mailbox.name],
            "mailbox": mailbox.name,
            "message": f"{mailbox.message} {mailbox.version}",
            "size": mailbox.size,
            "depth": mailbox.depth,
            "protocol": mailbox.protocol,
            "writer": mailbox.writer,
            "readers": mailbox.readers,
            "delay_ms": mailbox.delay * tick_ms,
        }
        for mailbox in layout.mailboxes
    ]
    return {
        "rack": config.name,
        "mode": config.clock.mode,
        "clock_ms": tick_ms,
        "clock_core": config.clock.core,
        "clock_priority": config.clock.priority,
        "segment_bytes": places.size,
        "windows": {window.board: window.address for window in places.windows},
        "tasks": tasks,
        "mailboxes": mailboxes,
        "notes": notes,
    }


def inventory_lines(found: Document, width: int | None = None) -> Iterator[str]:
    """Yield an inventory as text for people, the tables fitted to `width`."""
    boards = len({task["slot"] for task in found["tasks"]})
    crate = f"{boards} board{'s' * (boards > 1)} and the clock"
    yield f"rack {found['rack']}: {crate}, {found['clock_ms']:g} ms, {found['mode']}"
    yield from found["notes"]
    clock = [CLOCK_SLOT, "clock", found["clock_core"], found["clock_priority"] or "-", "", "", "", ""]
    rows = [
        [
            *(t["slot"], t["task"], t["core"], t["priority"] or "-"),
            *(f"{t['rate_hz']:g}", t["every_ticks"], f"{t['slice_ms']:g}", _hex(t["trace_address"])),
        ]
        for t in found["tasks"]
    ]
    head = ["slot", "task", "core", "FIFO", "rate, Hz", "ticks", "slice, ms", "trace at"]
    yield ""
    yield from _table(head, [clock, *rows], width, ("trace at", "slice, ms"))
    rows = [
        [
            *(_hex(m["address"]), m["mailbox"], m["message"], m["size"], m["depth"], m["protocol"]),
            *(f"{m['delay_ms']:g}", f"{m['writer']} > {', '.join(m['readers']) or '(nobody)'}"),
        ]
        for m in found["mailboxes"]
    ]
    head = ["bus address", "mailbox", "message", "bytes", "slots", "protocol", "delay, ms", "written by > read by"]
    yield ""
    yield from _table(head, rows, width, ("slots", "bytes", "message", "protocol"))
    yield ""
    windows = ", ".join(f"{board} {_hex(address)}" for board, address in found["windows"].items())
    yield f"segment: {found['segment_bytes']} bytes; board windows: {windows}"


def _table(head: list[str], rows: list[list[Any]], width: int | None, dropped: tuple[str, ...]) -> Iterator[str]:
    yield from table(head, [[str(cell) for cell in row] for row in rows], width, dropped)


def _hex(address: int) -> str:
    return f"0x{address:06x}"

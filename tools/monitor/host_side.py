"""Describes the host side of a running rack: its boards, and the messages of bus adapters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rack.backplane.bounded_toml import load_toml
from rack.backplane.checked import to_enum
from rack.backplane.layout import Layout
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Box, TaskState
from rack.tools.monitor.newest_messages import NewestMessages

ADAPTER_STATUS = "adapter_status"
"""Message type of the status of a bus adapter, with a group of counts for each entry."""
ENTRY_COUNTS = ("passed", "refused", "superseded", "full", "waiting")
"""Names of the counts of an entry."""
AWAY = "away"
"""State of a host board without a process: an external one, or one that is being restarted."""
DONE = "done"


@dataclass(frozen=True)
class HostRow:
    """Current state of a host board.

    Attributes:
        pid: Process id. 0 without a process.
        sent: Number of messages sent.
    """

    board: str
    pid: int
    state: str
    sent: int
    restarts: int


@dataclass(frozen=True)
class EntryRow:
    """An entry of a bus adapter, which passes messages to or from a host board, with its counts.

    Attributes:
        age_ms: Age of its newest message in ms of simulated time. None before the first message.
    """

    entry: str
    source: str
    passed: int
    refused: int
    superseded: int
    full: int
    waiting: int
    age_ms: float | None


def list_host_rows(segment: Segment) -> Iterator[HostRow]:
    """Yield the current state of every host board."""
    for host in segment.layout.hosts:
        block = segment.get_block(host.name)
        # The process of a host board locks this word. When it ends, the kernel unlocks the word.
        is_running = segment.is_locked(segment.map.blocks[host.name] + 8 * Block.PID)
        state = to_enum(TaskState, block[Block.STATE]).name.lower() if is_running else AWAY
        if block[Block.STATE] == TaskState.ENDED:
            state = DONE
        sent = sum(head[Box.HEAD] for head in _list_heads(segment, host.name))
        pid = block[Block.PID] if is_running else 0
        yield HostRow(host.name, pid, state, sent, count_restarts(segment, host.name))


def count_restarts(segment: Segment, writer: str) -> int:
    """Count how often a new process took over the mailboxes of a task or host board.

    Each new process increments the writer's epoch. The first process writes in epoch 1. Hand-overs
    to standbys, which increment it too, are not counted.
    """
    hand_overs = segment.get_block(writer)[Block.HAND_OVERS]
    return max([0, *(head[Box.EPOCH] - 1 - hand_overs for head in _list_heads(segment, writer))])


def _list_heads(segment: Segment, writer: str) -> list[memoryview]:
    """Return the header words of each mailbox that a task or host board writes."""
    return [segment.get_box(box.name) for box in segment.layout.mailboxes if box.writer == writer]


def list_entry_rows(newest: NewestMessages) -> Iterator[EntryRow]:
    """Yield the state of each entry of the bus adapters that have reported a status."""
    segment = newest.segment
    tick_ms = segment.layout.clock_ns * 1e-6
    for mailbox, entry, source in list_entries(segment.layout, segment.config):
        if (status := newest.read_message(mailbox)) is not None:
            counts = getattr(status, entry)
            age = int(counts["age"])
            age_ms = None if age < 0 else age * tick_ms
            numbers = {name: int(counts[name]) for name in ENTRY_COUNTS}
            board = mailbox.partition(".")[0]
            yield EntryRow(f"{board}.{entry}", source, **numbers, age_ms=age_ms)


def list_entries(layout: Layout, config: str) -> Iterator[tuple[str, str, str]]:
    """Yield status mailbox, name and source of every entry of a rack's bus adapters.

    Args:
        layout: Layout of the rack.
        config: Config of the rack as TOML text.
    """
    boxes = [box.name for box in layout.mailboxes if box.message == ADAPTER_STATUS]
    boards = load_toml(config)["board"] if boxes else {}
    for box in boxes:
        for entry, table in boards[box.partition(".")[0]].get("params", {}).get("pass", {}).items():
            yield box, entry, table["from"]

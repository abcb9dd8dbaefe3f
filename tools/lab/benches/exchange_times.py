"""How the messages of a run reached their readers: how evenly, how old they were when read, and how
many never did.

For every mailbox and reader alike, whatever its protocol, so that exchange by tables and by
interrupts can be compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.queue import is_position
from rack.levels.timing.trace_times import Distribution, distribution, newest_visible
from rack.tools.live.interrupts import BoardInterrupts, replayed
from rack.tools.recording.recording import Recording

MS = 1e-6


@dataclass(frozen=True)
class ExchangeTimes:
    """The messages of one mailbox at one reader.

    `jitter_ms`: by how much the time between two arrivals at the reader's board differs from that
    between the releases that wrote them. `age_ms`: in each of its cycles, the time since the
    release that wrote what it has. `sent` messages were written; `lost` never arrived, and
    `overtaken` arrived, but a newer one did before the next read.
    """

    mailbox: str
    writer: str
    reader: str
    protocol: str
    jitter_ms: Distribution | None
    age_ms: Distribution | None
    sent: int
    lost: int
    overtaken: int


class _Arrivals(NamedTuple):
    """The messages that arrived, in order, shape (n,): when, and the instant from which a reader
    can have each.

    `at_ns` is on the scale of the jitter, `seen_from` on that of the reader's instants, `reads`.
    """

    released: np.ndarray
    at_ns: np.ndarray
    seen_from: np.ndarray
    reads: np.ndarray


def exchange_times(recording: Recording) -> Iterator[ExchangeTimes]:
    """Yield the times of every sampled mailbox at each of its readers, in the order of the layout.

    Queues, and mailboxes that operators or host boards write, are left out, as are readers that
    left no trace.
    """
    layout = recording.layout
    boards = dict[int, BoardInterrupts]()
    tasks = {task.name: task for task in layout.tasks}
    for box in layout.timed:
        if box.protocol == "queue" or is_position(box) or box.writer == CLOCK:
            continue
        for reader in box.readers:
            if reader not in tasks or not len(recording.trace(reader)):
                continue
            slot = tasks[reader].slot
            if box.interrupt is not None and slot in box.interrupt.slots and slot not in boards:
                boards[slot] = replayed(recording, slot)
            yield _times(recording, box, reader, boards.get(slot))


def _times(
    recording: Recording, box: MailboxSpec, reader: str, board: BoardInterrupts | None
) -> ExchangeTimes:
    clock_ns = recording.layout.clock_ns
    serials = recording.signal(box.name, "serial")
    found = _arrivals(recording, box, reader, board)
    cycles = recording.trace(reader)["tick"]
    reads = found.reads
    newest = newest_visible(reads, found.seen_from)
    known = newest >= 0
    read = np.unique(newest[known])
    uneven = np.diff(found.at_ns) - np.diff(found.released) * clock_ns
    sent = (
        int(serials[-1] - serials[0] + 1) - recording.lost.get(box.name, 0) if len(serials) else 0
    )
    overtaken = int(read[-1]) + 1 - len(read) if len(read) else 0
    return ExchangeTimes(
        mailbox=box.name,
        writer=box.writer,
        reader=reader,
        protocol=box.protocol,
        jitter_ms=distribution(np.abs(uneven) * MS),
        age_ms=distribution((cycles[known] - found.released[newest[known]]) * clock_ns * MS),
        sent=sent,
        lost=max(0, sent - len(found.released)),
        overtaken=overtaken,
    )


def _arrivals(
    recording: Recording, box: MailboxSpec, reader: str, board: BoardInterrupts | None
) -> _Arrivals:
    """Return the arrivals of a mailbox at a reader, and when that reads, by its protocol."""
    layout = recording.layout
    rows = recording.trace(reader)
    released, visible_at = (
        recording.signal(box.name, name).astype(np.int64) for name in ("tick", "visible_at")
    )
    grid = layout.read_grid(box, reader)
    # Between two reads the message of the last one stays.
    reads = rows["tick"] - (rows["tick"] - grid.phase) % grid.every
    if board is not None and box.name in board.mailboxes:
        delivered = board.mailboxes[box.name]
        served = delivered.is_served
        ends = delivered.end_ns[delivered.is_served]
        return _Arrivals(released[served], ends, ends, reads * layout.clock_ns)
    is_early = any(exchange.task == reader and exchange.asynchronous for exchange in box.exchanges)
    if box.is_by_ticks and not is_early:
        return _Arrivals(released, visible_at * layout.clock_ns, visible_at, reads)
    # Visible as soon as they are whole: by the wall clock, which in lockstep orders them but says
    # nothing of evenness.
    stamps = recording.signal(box.name, "stamp_ns")
    is_lockstep = recording.rack_config.clock.mode == "lockstep"
    at_ns = (
        released * layout.clock_ns
        if is_lockstep
        else np.rint(stamps * recording.rack_config.clock.speed)
    )
    is_own = f"{recording.layout.task(reader).board}.plan" == box.name
    read_at = rows["start_ns"] if is_own else rows["plan_ns"]
    cycles = np.maximum(np.searchsorted(rows["tick"], reads, side="right") - 1, 0)
    return _Arrivals(released, at_ns, stamps, read_at[cycles])

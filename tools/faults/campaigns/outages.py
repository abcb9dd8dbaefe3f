"""Interruptions of a board's output by faults: their length, and the messages missing."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence

from rack.backplane.layout import Layout
from rack.backplane.mailbox.slots import Slots
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Slot
from rack.boards.events import Event
from rack.tools.faults.ending import Strike


def count_missing_messages(segment: Segment, boards: Collection[str]) -> int:
    """Return the number of messages that executors have not written, up to the newest of each.

    Args:
        segment: Memory of the rack.
        boards: Boards of the executors.
    """
    missing = 0
    for spec in segment.layout.mailboxes:
        if spec.writer not in boards or spec.protocol == "queue" or spec.max_age:
            continue
        slots = Slots(segment, spec)
        if head := slots.box[Box.HEAD]:
            newest = slots.heads[head & slots.mask][Slot.TICK]
            first = (spec.phase - spec.lead_ticks) % spec.every
            missing += (newest - first) // spec.every + 1 - head
    return missing


def list_outages(
    strikes: Iterable[Strike], events: Sequence[Event], layout: Layout
) -> Iterator[int]:
    """Yield the time without output after each fault that ended the process of an executor.

    Args:
        strikes: Faults of the run.
        events: Events of the run.
        layout: Layout of the rack.

    Yields:
        Ticks from the fault to the next cycle of its board that writes messages.
    """
    for strike in strikes:
        if strike.tick < 0 or not strike.record.consequence.ends_process:
            continue
        copies = {
            task.name
            for task in layout.tasks
            if layout.find_first_copy(task.name) == layout.find_first_copy(strike.board)
        }
        back = (
            event.tick - strike.tick
            for event in events
            if event.code in ("taken_over", "rejoined")
            and event.board in copies
            and event.tick >= strike.tick
        )
        if (ticks := min(back, default=None)) is not None:
            yield ticks

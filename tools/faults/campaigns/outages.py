"""Interruptions of a board's output by faults: their length, and the messages missing."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

from rack.backplane.layout import Layout
from rack.backplane.mailbox.slots import Slots
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Slot
from rack.boards.events import Event
from rack.tools.faults.ending import Strike
from rack.tools.faults.evidence import BRAKES, SKIPPED


class Outage(NamedTuple):
    """Time without output after a fault that ended the process of an executor.

    Attributes:
        ticks: Ticks from the fault to the next cycle of its board that writes messages.
        has_braked: True if the brakes engaged in this time.
    """

    ticks: int
    has_braked: bool


def count_missing_messages(
    segment: Segment, boards: Collection[str], events: Iterable[Event]
) -> int:
    """Return the number of messages that executors have not written, up to the newest of each.

    Messages of ticks that the clock skipped are not counted.

    Args:
        segment: Memory of the rack.
        boards: Boards of the executors.
        events: Events of the run.
    """
    # Every board reports the same ticks.
    ranges = {(event.since, int(event.value)) for event in events if event.code == SKIPPED}
    skipped = {tick for first, count in ranges for tick in range(first, first + count)}
    missing = 0
    for spec in segment.layout.mailboxes:
        if spec.writer not in boards or spec.protocol == "queue" or spec.max_age:
            continue
        slots = Slots(segment, spec)
        if head := slots.box[Box.HEAD]:
            newest = slots.heads[head & slots.mask][Slot.TICK]
            first = -spec.due_offset % spec.every
            due = set(range(first, newest + 1, spec.every)) - skipped
            # A board that babbles has written more messages than were due.
            missing += max(0, len(due) - head)
    return missing


def list_outages(
    strikes: Iterable[Strike], events: Sequence[Event], layout: Layout
) -> Iterator[Outage]:
    """Yield the time without output after each fault that ended the process of an executor.

    Args:
        strikes: Faults of the run.
        events: Events of the run.
        layout: Layout of the rack.
    """
    brakings = [event.tick for event in events if event.code == BRAKES]
    for strike in strikes:
        if strike.tick < 0 or not strike.record.consequence.ends_process:
            continue
        copies = {
            task.name
            for task in layout.tasks
            if layout.find_first_copy(task.name) == layout.find_first_copy(strike.board)
        }
        returns = (
            event.tick
            for event in events
            if event.code in ("taken_over", "rejoined")
            and event.board in copies
            and event.tick >= strike.tick
        )
        if (back := min(returns, default=None)) is not None:
            # Torque that is missing in a tick is noticed in the next one.
            has_braked = any(strike.tick <= tick <= back + 1 for tick in brakings)
            yield Outage(back - strike.tick, has_braked)

"""What interrupted the boards of a rack, under protocol interrupt: now, and message by message in a
run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rack.backplane.layout import Layout
from rack.backplane.mailbox.inbox import Inbox
from rack.backplane.mailbox.interrupt import how_sent, sent_ns
from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.levels.timing.trace_times import distribution
from rack.tools.console.answer import Document

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording

LOST = np.iinfo(np.int64).max
"""End of service of a message that was lost in the inbox."""


@dataclass(frozen=True)
class InboxFill:
    """The inbox of a board, so far: messages `served` and `lost`, and the most that waited, of at
    most `depth`."""

    board: str
    served: int
    lost: int
    waiting: int
    depth: int

    @property
    def line(self) -> str:
        """The inbox as one line."""
        lost = f", {self.lost} lost" if self.lost else ""
        return (
            f"interrupts of {self.board}: {self.served} served, at most {self.waiting} of"
            f" {self.depth} waited{lost}"
        )


def inbox_depths(layout: Layout) -> dict[int, int]:
    """Return the depth of the inbox of every board that messages interrupt, by slot."""
    slots = dict.fromkeys(task.slot for task in layout.tasks)
    boxes = {slot: layout.interrupting(slot) for slot in slots}
    return {slot: how_sent(found[0]).depth for slot, found in boxes.items() if found}


class Inboxes:
    """Looks at the inboxes of a rack, from the host side."""

    def __init__(self, segment: Segment) -> None:
        depths = {
            segment.layout.handler(slot): depth
            for slot, depth in inbox_depths(segment.layout).items()
        }
        self._blocks = [(name, segment.block(name), depth) for name, depth in depths.items()]

    def look(self) -> tuple[InboxFill, ...]:
        """Return the inbox of every board that messages interrupt, as it is now."""
        served = Block.INTERRUPTS
        lost = Block.INTERRUPTS_LOST
        waiting = Block.INTERRUPTS_WAITING
        return tuple(
            InboxFill(name, block[served], block[lost], block[waiting], depth)
            for name, block, depth in self._blocks
        )


class Delivered(NamedTuple):
    """The messages of one mailbox at a board that they interrupt; ns of simulated time since tick
    0, shape (n,)."""

    sent_ns: np.ndarray
    end_ns: np.ndarray  # of the service; `LOST` where the inbox was full

    @property
    def is_served(self) -> np.ndarray:
        """Which of them were served, bool, shape (n,)."""
        return np.asarray(self.end_ns != LOST)


class BoardInterrupts(NamedTuple):
    """What interrupted a board in a run, by mailbox, and the most that waited."""

    mailboxes: dict[str, Delivered]
    waiting: int


def replayed(recording: Recording, slot: int) -> BoardInterrupts:
    """Work the inbox of the board in a slot out again from the messages of a run, as the board
    did."""
    layout = recording.layout
    boxes = layout.interrupting(slot)
    visible = [recording.signal(box.name, "visible_at").astype(np.int64) for box in boxes]
    # A message that comes after a later one of its mailbox is sent with that.
    first = [sent_ns(box, layout.clock_ns) for box in boxes]
    sent = [
        np.maximum.accumulate(at * layout.clock_ns) + ns
        for at, ns in zip(visible, first, strict=True)
    ]
    ends = [np.full(len(at), LOST) for at in sent]
    numbers = np.repeat(np.arange(len(boxes)), [len(at) for at in sent])
    serials = np.concatenate([np.arange(len(at)) for at in sent])
    times = np.concatenate(sent)
    inbox = Inbox(how_sent(boxes[0]).depth)
    services = [how_sent(box).service_ns for box in boxes]
    for at in np.lexsort((serials, numbers, times)).tolist():
        number = int(numbers[at])
        end_ns = inbox.arrive(int(times[at]), services[number])
        if end_ns is not None:
            ends[number][serials[at]] = end_ns
    pairs = zip(boxes, sent, ends, strict=True)
    return BoardInterrupts(
        {box.name: Delivered(at, end) for box, at, end in pairs}, inbox.most_waiting
    )


def interrupts(recording: Recording) -> list[Document]:
    """Return what interrupted every board in a run: messages served and lost, the most that waited,
    latencies.

    A latency, us, is the time from sending a message to the end of its service; then a level can
    see it.
    """
    layout = recording.layout
    found = []
    for slot, depth in inbox_depths(layout).items():
        board = replayed(recording, slot)
        served = {
            name: int(np.count_nonzero(one.is_served)) for name, one in board.mailboxes.items()
        }
        took = [(one.end_ns - one.sent_ns)[one.is_served] for one in board.mailboxes.values()]
        found.append(
            {
                "board": layout.handler(slot),
                "depth": depth,
                "served": sum(served.values()),
                "lost": (
                    sum(len(one.sent_ns) for one in board.mailboxes.values()) - sum(served.values())
                ),
                "waiting": board.waiting,
                "latency_us": distribution(np.concatenate(took) * 1e-3),
                "mailboxes": [
                    {
                        "mailbox": name,
                        "served": served[name],
                        "lost": len(one.sent_ns) - served[name],
                    }
                    for name, one in board.mailboxes.items()
                ],
            }
        )
    return found

"""Describes interrupts of boards by messages, in a running rack or in a recorded run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rack.backplane.layout import Layout
from rack.backplane.mailbox.inbox import Inbox
from rack.backplane.mailbox.interrupt import compute_send_offset_ns, get_interrupt_spec
from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.boards.timing.trace_times import compute_distribution
from rack.tools.console.answer import Document

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording

NEVER_SERVED = np.iinfo(np.int64).max
"""End of service of a message that was lost because the inbox was full."""


@dataclass(frozen=True)
class InboxFill:
    """State of a board's inbox, with counts since the start of the run.

    Attributes:
        served: Number of messages that interrupted the board.
        lost: Number of messages lost because the inbox was full.
        waiting: Largest number of messages that waited at once.
        depth: Capacity of the inbox.
    """

    board: str
    served: int
    lost: int
    waiting: int
    depth: int

    @property
    def line(self) -> str:
        """Description of the inbox in one line."""
        lost = f", {self.lost} lost" if self.lost else ""
        return (
            f"interrupts of {self.board}: {self.served} served, at most {self.waiting} of"
            f" {self.depth} waited{lost}"
        )


def find_inbox_depths(layout: Layout) -> dict[int, int]:
    """Return a dictionary from slot to inbox depth, for each board that messages interrupt."""
    slots = dict.fromkeys(task.slot for task in layout.tasks)
    return {
        slot: get_interrupt_spec(boxes[0]).depth
        for slot in slots
        if (boxes := layout.list_interrupting_mailboxes(slot))
    }


def list_inbox_fills(segment: Segment) -> Iterator[InboxFill]:
    """Yield the state of the inbox of every board that messages interrupt."""
    for slot, depth in find_inbox_depths(segment.layout).items():
        board = segment.layout.find_interrupt_task(slot)
        block = segment.get_block(board)
        served, lost = block[Block.INTERRUPTS], block[Block.INTERRUPTS_LOST]
        yield InboxFill(board, served, lost, block[Block.INTERRUPTS_WAITING], depth)


class Arrivals(NamedTuple):
    """The messages that interrupted a board, grouped by mailbox. Arrays have shape (n,).

    Times are in ns of simulated time since tick 0.
    """

    mailbox: np.ndarray  # index in `Layout.list_interrupting_mailboxes`
    sent_ns: np.ndarray
    end_ns: np.ndarray  # end of service; `NEVER_SERVED` if the inbox was full
    most_waiting: int


def replay_inbox(recording: Recording, slot: int) -> Arrivals:
    """Reconstruct the inbox of the board in a slot from the recorded messages of a run."""
    layout = recording.layout
    boxes = layout.list_interrupting_mailboxes(slot)
    sent = []
    for box in boxes:
        visible_at = recording.read_signal(box.name, "visible_at").astype(np.int64)
        # No message is delivered before an earlier one of the same mailbox.
        newest = np.maximum.accumulate(visible_at * layout.clock_ns)
        sent.append(newest + compute_send_offset_ns(box, layout.clock_ns))
    times = np.concatenate(sent)
    numbers = np.repeat(np.arange(len(boxes)), [len(index) for index in sent])
    ends = np.full(len(times), NEVER_SERVED)
    inbox = Inbox(get_interrupt_spec(boxes[0]).depth)
    services = [get_interrupt_spec(box).service_ns for box in boxes]
    for index in np.lexsort((numbers, times)).tolist():
        end_ns = inbox.add_message(int(times[index]), services[numbers[index]])
        if end_ns is not None:
            ends[index] = end_ns
    return Arrivals(numbers, times, ends, inbox.most_waiting)


def summarize_interrupts(recording: Recording) -> Iterator[Document]:
    """Describe the interrupts of every board in a run, as plain data.

    Latencies, in us, are measured from the sending of a message to the end of its service, when a
    level can read it.
    """
    layout = recording.layout
    for slot, depth in find_inbox_depths(layout).items():
        arrivals = replay_inbox(recording, slot)
        is_served = arrivals.end_ns != NEVER_SERVED
        boxes = layout.list_interrupting_mailboxes(slot)
        served, lost = (
            np.bincount(arrivals.mailbox[mask], minlength=len(boxes)).tolist()
            for mask in (is_served, ~is_served)
        )
        latency_ns = (arrivals.end_ns - arrivals.sent_ns)[is_served]
        yield {
            "board": layout.find_interrupt_task(slot),
            "depth": depth,
            "served": sum(served),
            "lost": sum(lost),
            "waiting": arrivals.most_waiting,
            "latency_us": compute_distribution(latency_ns * 1e-3),
            "mailboxes": [
                {"mailbox": box.name, "served": served[at], "lost": lost[at]}
                for at, box in enumerate(boxes)
            ],
        }

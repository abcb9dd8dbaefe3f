"""Describes how full the queues of a rack are, or were in a run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rack.backplane.mailbox.queue import get_position_mailbox, list_queues
from rack.backplane.words import Box
from rack.tools.console.answer import Document
from rack.tools.monitor.newest_messages import NewestMessages

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording


@dataclass(frozen=True)
class QueueFill:
    """Current state of a queue.

    Attributes:
        unread: Number of messages in the queue.
        capacity: Maximum number of messages.
        refused: Number of messages refused so far because the queue was full.
    """

    mailbox: str
    unread: int
    capacity: int
    refused: int

    @property
    def line(self) -> str:
        """Description of the queue in one line."""
        refused = f", {self.refused} refused" if self.refused else ""
        return f"queue {self.mailbox}: {self.unread} of {self.capacity} unread{refused}"


def list_queue_fills(newest: NewestMessages) -> Iterator[QueueFill]:
    """Yield the current state of every queue of a rack."""
    for box in list_queues(newest.segment.layout):
        # Read the reader's position first: messages taken after this still count as unread.
        position = newest.read_message(get_position_mailbox(box.name))
        words = newest.segment.get_box(box.name)
        unread = words[Box.SENT] - (0 if position is None else position.taken)
        yield QueueFill(box.name, unread, box.capacity, words[Box.REFUSED])


def summarize_queues(recording: Recording) -> Iterator[Document]:
    """Describe the traffic of every queue in a run, as plain data.

    `waiting` is the largest number of messages in the queue at the beginning of a read. `refused`
    is None if it was not recorded.
    """
    refused = recording.end_counts.get("refused", {})
    for box in list_queues(recording.layout):
        taken, unread = (
            recording.read_signal(get_position_mailbox(box.name), field)
            for field in ("taken", "unread")
        )
        before = np.concatenate(([0], taken[:-1]))
        yield {
            "mailbox": box.name,
            "capacity": box.capacity,
            "sent": int(recording.read_signal(box.name, "serial").max(initial=0)),
            "taken": int(taken.max(initial=0)),
            "waiting": int((taken + unread - before).max(initial=0)),
            "refused": refused.get(box.name),
        }

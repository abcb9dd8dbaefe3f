"""How full the queues of a rack are, and were in a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rack.backplane.mailbox.queue import queues_of, taken_name
from rack.backplane.words import Box
from rack.tools.console.answer import Document
from rack.tools.monitor.newest_messages import Newest

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording


@dataclass(frozen=True)
class QueueFill:
    """A queue now: `unread` messages, of at most `capacity`, and how many were refused so far
    because it was full.
    """

    mailbox: str
    unread: int
    capacity: int
    refused: int

    @property
    def line(self) -> str:
        """The queue as one line."""
        refused = f", {self.refused} refused" if self.refused else ""
        return f"queue {self.mailbox}: {self.unread} of {self.capacity} unread{refused}"


def queue_fills(newest: Newest) -> tuple[QueueFill, ...]:
    """Return every queue of a rack as it is now."""
    found = []
    for box in queues_of(newest.segment.layout):
        # The position first: what is taken meanwhile was in the queue.
        position = newest.message(taken_name(box.name))
        words = newest.segment.box(box.name)
        unread = words[Box.SENT] - (0 if position is None else position.taken)
        found.append(QueueFill(box.name, unread, box.capacity, words[Box.REFUSED]))
    return tuple(found)


def queues(recording: Recording) -> list[Document]:
    """Return what went through every queue: messages `sent`, `refused` (None: not recorded), most
    that ever waited.

    `waiting` counts the messages that a read could see, before it took any.
    """
    refused = recording.ended.get("refused", {})
    found = []
    for box in queues_of(recording.layout):
        taken, unread = (
            recording.signal(taken_name(box.name), field) for field in ("taken", "unread")
        )
        before = np.concatenate(([0], taken[:-1]))
        found.append(
            {
                "mailbox": box.name,
                "capacity": box.capacity,
                "sent": int(recording.signal(box.name, "serial").max(initial=0)),
                "taken": int(taken.max(initial=0)),
                "waiting": int((taken + unread - before).max(initial=0)),
                "refused": refused.get(box.name),
            }
        )
    return found

"""Reads the newest messages in the mailboxes of a running rack."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.mailbox import Reader
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment


class NewestMessages:
    """Reads the newest message of any mailbox of a rack.

    Each mailbox is opened only once, because opening takes longer than many reads.
    """

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self._readers: dict[str, Reader] = {}

    def read_message(self, mailbox: str) -> AnyMessage | None:
        """Return the newest message of a mailbox.

        None if the mailbox does not exist or has no message yet.
        """
        if mailbox not in self.segment.map.mailboxes:
            return None
        if mailbox not in self._readers:
            self._readers[mailbox] = open_observer(self.segment, mailbox)
        reading = self._readers[mailbox].peek()
        return reading.message if reading.has_message else None

    def list_messages(
        self, is_wanted: Callable[[MailboxSpec], bool]
    ) -> Iterator[tuple[str, AnyMessage]]:
        """Yield writer and newest message of each non-empty mailbox that `is_wanted` accepts."""
        for box in self.segment.layout.mailboxes:
            if is_wanted(box) and (message := self.read_message(box.name)) is not None:
                yield box.writer, message

    def list_statuses(self, field: str) -> Iterator[tuple[str, AnyMessage]]:
        """Yield level and newest status for every level whose status has a given field."""
        return self.list_messages(
            lambda box: (
                box.name.endswith(".status")
                and field in (box_field.name for box_field in box.fields)
            )
        )

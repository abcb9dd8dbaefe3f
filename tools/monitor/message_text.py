"""Formats the mailboxes of a rack as rows, and a message field by field with units."""

from __future__ import annotations

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.backplane.segment import Segment
from rack.backplane.words import Box
from rack.tools.console.answer import Document
from rack.tools.console.tables import format_fitted_table
from rack.tools.monitor.signals import format_value
from rack.tools.recording.parquet import HEAD_COLUMNS
from rack.tools.recording.signal import list_signals

DROPPED = ("bytes", "message", "protocol", "readers")
"""Columns of the list of mailboxes that a narrow terminal leaves out, in this order."""


def list_mailboxes(segment: Segment) -> list[Document]:
    """Return a row of plain data for each mailbox of a rack."""
    return [
        {
            "mailbox": box.name,
            "message": f"{box.message} {box.version}",
            "writer": box.writer,
            "readers": ", ".join(box.readers) or "-",
            "protocol": box.protocol,
            "period_ms": round(box.every * segment.layout.clock_ns * 1e-6, 6),
            "bytes": box.size,
            "written": segment.get_box(box.name)[Box.HEAD],
        }
        for box in segment.layout.mailboxes
    ]


class MessageFormatter:
    """Formats the messages of one mailbox.

    Args:
        box: The mailbox.
        clock_ns: Clock period of its rack.
    """

    def __init__(self, box: MailboxSpec, clock_ns: int) -> None:
        self._box = box
        self._clock_ns = clock_ns
        self._signals = list_signals(box)

    def to_document(self, row: np.ndarray, tick: int) -> Document:
        """Convert a message to a document.

        Args:
            row: Row of the mailbox's ring.
            tick: Current tick, for the age of the message.
        """
        message = row["message"][None]
        return {
            "mailbox": self._box.name,
            **{name: int(row[name]) for name in HEAD_COLUMNS},
            "age_ticks": tick - int(row["tick"]),
            "fields": {
                ".".join(signal.path): signal.extract_plain(message)[0] for signal in self._signals
            },
        }

    def format_lines(self, document: Document) -> list[str]:
        """Format the document of a message as readable lines."""
        age_ms = document["age_ticks"] * self._clock_ns * 1e-6
        head = (
            f"{self._box.name}: serial {document['serial']}, of tick {document['tick']},"
            f" {document['age_ticks']} ticks ({age_ms:g} ms) old"
        )
        rows = [
            [name, format_value(value), signal.unit]
            for (name, value), signal in zip(document["fields"].items(), self._signals, strict=True)
        ]
        return [head, *format_fitted_table(("field", "value", "unit"), rows)]

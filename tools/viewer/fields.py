"""The numbers of any message as curves: what a user's own level writes shows without a word about it."""

from __future__ import annotations

from math import prod

import rerun as rr

from rack.backplane.layout import FieldSpec, MailboxSpec
from rack.tools.viewer.blocks import Block
from rack.tools.viewer.stream import Stream

SIGNALS = "signals"
MOST_CURVES = 16
"""Fields with more numbers than this are tables, no curves; the Parquet file has them."""


class Fields:
    """Writes every numeric field of a mailbox, as it was written."""

    def __init__(self, stream: Stream, mailbox: MailboxSpec) -> None:
        self._stream = stream
        self._fields = [field for field in mailbox.fields if is_curve(field)]
        self._lanes = {field.name: (SIGNALS, mailbox.name, field.name) for field in self._fields}
        for field in self._fields:
            unit = "" if field.unit in ("", "1") else f", {field.unit}"
            places = [f"[{at}]" for at in range(prod(field.shape))] if field.shape else [""]
            curves = [f"{mailbox.name}.{field.name}{place}{unit}" for place in places]
            stream.static(self._lanes[field.name], rr.SeriesLines(names=curves))

    def write(self, block: Block) -> None:
        """Write all rows."""
        for field in self._fields:
            values = block.messages[field.name].astype(float)
            self._stream.scalars(self._lanes[field.name], block.times, values.reshape(len(values), -1))


def is_curve(field: FieldSpec) -> bool:
    """Return whether a field can be shown as curves."""
    return not field.fields and field.kind[1] in "iufb" and 0 < prod(field.shape) <= MOST_CURVES

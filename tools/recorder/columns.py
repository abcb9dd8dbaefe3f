"""Messages as columns: one a field, groups of fields flattened, arrays as lists of one length."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import prod

import numpy as np
import pyarrow as pa

from rack.backplane.layout import FieldSpec, MailboxSpec


@dataclass(frozen=True)
class Column:
    """One field of a mailbox: the path to it in a message, and its column `<mailbox>.<path>`.

    `shape` is () for a single value, else that of one row's list.
    """

    name: str
    path: tuple[str, ...]
    kind: str
    shape: tuple[int, ...]
    unit: str

    @property
    def field(self) -> pa.Field:
        """The column's Arrow field; its shape and unit stand in the metadata."""
        element = pa.string() if self.kind[1] == "S" else pa.from_numpy_dtype(np.dtype(self.kind))
        # Every row has the same length, yet no fixed-size list: its nulls, in the rows of all other mailboxes,
        # would cost as much memory as values.
        arrow = pa.list_(element) if self.shape else element
        return pa.field(self.name, arrow, metadata={"shape": json.dumps(self.shape), "unit": self.unit})

    def array(self, messages: np.ndarray) -> pa.Array:
        """Return the column of a block of messages, shape (rows,)."""
        for key in self.path:
            messages = messages[key]
        flat = np.ascontiguousarray(messages).reshape(-1)
        values = pa.array(np.strings.decode(flat, "ascii", "replace") if self.kind[1] == "S" else flat)
        if not self.shape:
            return values
        offsets = np.arange(len(messages) + 1, dtype=np.int32) * prod(self.shape)
        return pa.ListArray.from_arrays(offsets, values)


def columns_of(mailbox: MailboxSpec) -> list[Column]:
    """Return the columns of a mailbox, in the order of its fields."""
    return list(_columns(mailbox.name, (), (), mailbox.fields))


def _columns(
    mailbox: str, path: tuple[str, ...], outer: tuple[int, ...], fields: Sequence[FieldSpec]
) -> Iterator[Column]:
    for field in fields:
        inner, shape = (*path, field.name), outer + field.shape
        if field.fields:
            yield from _columns(mailbox, inner, shape, field.fields)
        else:
            yield Column(".".join((mailbox, *inner)), inner, field.kind, shape, field.unit)

"""signals.parquet: what every task wrote to its mailboxes, one row a message.

Each row group holds rows of one mailbox: its own columns are filled, those of all others null.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rack.backplane.layout import Layout
from rack.tools.recorder.columns import columns_of

HEAD = ("serial", "tick", "visible_at", "basis", "stamp_ns", "chain")
BLOCK_ROWS = 8192
BLOCK_BYTES = 16 << 20
"""Rows go to the file in large blocks: its footer has an entry for every column of every block."""


class SignalsFile:
    """Collects blocks of messages by mailbox and writes them when they are large."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self._columns = {mailbox.name: columns_of(mailbox) for mailbox in layout.mailboxes}
        self._waiting: dict[str, list[np.ndarray]] = {name: [] for name in self._columns}
        head = [pa.field("mailbox", pa.string()), *(pa.field(name, pa.int64()) for name in HEAD)]
        fields = head + [column.field for columns in self._columns.values() for column in columns]
        self._schema = pa.schema(fields, metadata={"layout": json.dumps(asdict(layout))})
        texts = [column.name for columns in self._columns.values() for column in columns if column.kind[1] == "S"]
        self._writer = pq.ParquetWriter(
            path,
            self._schema,
            compression="zstd",
            use_dictionary=["mailbox", *texts],
            write_statistics=["mailbox", "tick"],
        )

    def add(self, mailbox: str, rows: np.ndarray) -> None:
        """Take rows of a mailbox's ring, shape (rows,)."""
        if not len(rows):
            return
        waiting = self._waiting[mailbox]
        waiting.append(rows)
        if sum(map(len, waiting)) >= BLOCK_ROWS or sum(block.nbytes for block in waiting) >= BLOCK_BYTES:
            self._flush(mailbox)

    def _flush(self, mailbox: str) -> None:
        blocks, self._waiting[mailbox] = self._waiting[mailbox], []
        if not blocks:
            return
        rows = np.concatenate(blocks)
        filled = {"mailbox": pa.array([mailbox] * len(rows))}
        filled |= {name: pa.array(np.ascontiguousarray(rows[name])) for name in HEAD}
        filled |= {column.name: column.array(rows["message"]) for column in self._columns[mailbox]}
        arrays = [filled[f.name] if f.name in filled else pa.nulls(len(rows), f.type) for f in self._schema]
        self._writer.write_batch(pa.record_batch(arrays, schema=self._schema), row_group_size=len(rows))

    def close(self, lost: Mapping[str, int]) -> None:
        """Write what waits, and by mailbox the rows that were lost; finish the file."""
        for mailbox in self._waiting:
            self._flush(mailbox)
        self._writer.add_key_value_metadata({"lost": json.dumps(lost)})
        self._writer.close()

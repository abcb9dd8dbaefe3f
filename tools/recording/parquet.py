"""The two parquet tables of a run.

cycles.parquet is the trace: one row a cycle of a task, the same columns for all tasks.
signals.parquet is what the tasks wrote to their mailboxes: one row a message. It is a folder, which
parquet's readers take for one table: a long run has many parts. Each row group holds rows of one
mailbox, whose own columns are filled; those of all others are null. The metadata hold when the rack
was launched, and the checksum of the config.toml next to it: a config that is cut off at the end of
a table is a valid config.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import prod
from pathlib import Path
from shutil import rmtree

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from xxhash import xxh3_64_hexdigest

from rack.backplane.layout import FieldSpec, Layout, MailboxSpec
from rack.backplane.segment import Launch
from rack.backplane.trace import FIELDS
from rack.tools.recording.cores import UNMEASURED, CoreRecord

TRACE_SCHEMA = pa.schema(
    [pa.field("task", pa.string()), *(pa.field(name, pa.int64()) for name in FIELDS)]
)
CONFIG = "config.toml"
HEAD = ("serial", "tick", "visible_at", "basis", "stamp_ns", "chain")
"""Columns that the messages of all mailboxes have."""
TRACE_ROWS = 1 << 16
MESSAGE_ROWS = 8192
MESSAGE_BYTES = 16 << 20
"""Rows are written in large blocks: a file's footer has an entry for every column of every
block."""
PART = "{:04}.parquet"
PART_ENTRIES = 1 << 14
"""Entries after which a part is finished: until then they are in memory, 0.7 kB each."""


def config_check(folder: Path) -> str:
    """Return the checksum of a run's config.toml; empty where there is none."""
    path = folder / CONFIG
    return xxh3_64_hexdigest(path.read_bytes()) if path.is_file() else ""


class CyclesFile:
    """cycles.parquet, being written."""

    def __init__(self, path: Path) -> None:
        self._waiting: list[tuple[str, np.ndarray]] = []
        self._rows = 0
        self._writer = pq.ParquetWriter(
            path, TRACE_SCHEMA, compression="zstd", use_dictionary=["task"]
        )

    def add(self, task: str, rows: np.ndarray) -> None:
        """Add trace records of a task, shape (rows,)."""
        if len(rows):
            self._waiting.append((task, rows))
            self._rows += len(rows)
        if self._rows >= TRACE_ROWS:
            self._flush()

    def _flush(self) -> None:
        if not self._waiting:
            return
        # Sorted by task, so that the rows of each are contiguous.
        waiting = sorted(self._waiting, key=lambda block: block[0])
        rows = np.concatenate([block for _, block in waiting])
        names = np.repeat([task for task, _ in waiting], [len(block) for _, block in waiting])
        arrays = [pa.array(names), *(pa.array(np.ascontiguousarray(rows[name])) for name in FIELDS)]
        self._writer.write_batch(
            pa.record_batch(arrays, schema=TRACE_SCHEMA), row_group_size=len(rows)
        )
        self._waiting = []
        self._rows = 0

    def close(
        self,
        lost: Mapping[str, int],
        cores: CoreRecord = UNMEASURED,
        gaps: Sequence[tuple[str, int, int]] = (),
    ) -> None:
        """Finish the file; store as metadata the rows lost by task, what the machine did to its
        cores, and the gaps."""
        self._flush()
        metadata = {"lost": json.dumps(lost), "cores": cores.text(), "gaps": json.dumps(gaps)}
        self._writer.add_key_value_metadata(metadata)
        self._writer.close()


class SignalsFile:
    """signals.parquet, being written; one that a killed recorder has left is replaced."""

    def __init__(self, path: Path, layout: Layout, launch: Launch | None = None) -> None:
        self._columns = {mailbox.name: columns_of(mailbox) for mailbox in layout.mailboxes}
        self._waiting: dict[str, list[np.ndarray]] = {name: [] for name in self._columns}
        head = [
            pa.field("mailbox", pa.string()),
            *(pa.field(name, pa.uint64() if name == "chain" else pa.int64()) for name in HEAD),
        ]
        fields = head + [column.field for columns in self._columns.values() for column in columns]
        metadata = {"layout": json.dumps(asdict(layout)), "config": config_check(path.parent)}
        metadata |= {} if launch is None else {"launch": json.dumps(launch)}
        self._schema = pa.schema(fields, metadata=metadata)
        self._folder = path
        if path.exists():
            rmtree(path)
        path.mkdir()
        self._parts = 0
        self._begin_part()

    def _begin_part(self) -> None:
        self._parts += 1
        self._entries = 0
        texts = [
            column.name
            for columns in self._columns.values()
            for column in columns
            if column.kind[1] == "S"
        ]
        self._writer = pq.ParquetWriter(
            self._folder / PART.format(self._parts),
            self._schema,
            compression="zstd",
            use_dictionary=["mailbox", *texts],
            write_statistics=["mailbox", "tick"],
        )

    def add(self, mailbox: str, rows: np.ndarray) -> None:
        """Add rows of a mailbox's ring, shape (rows,), at least one."""
        waiting = self._waiting[mailbox]
        waiting.append(rows)
        if (
            sum(map(len, waiting)) >= MESSAGE_ROWS
            or sum(block.nbytes for block in waiting) >= MESSAGE_BYTES
        ):
            self._flush(mailbox)

    def _flush(self, mailbox: str) -> None:
        blocks = self._waiting[mailbox]
        self._waiting[mailbox] = []
        if not blocks:
            return
        rows = np.concatenate(blocks)
        filled = {"mailbox": pa.array([mailbox] * len(rows))}
        filled |= {name: pa.array(np.ascontiguousarray(rows[name])) for name in HEAD}
        filled |= {column.name: column.array(rows["message"]) for column in self._columns[mailbox]}
        arrays = [
            filled[f.name] if f.name in filled else pa.nulls(len(rows), f.type)
            for f in self._schema
        ]
        self._writer.write_batch(
            pa.record_batch(arrays, schema=self._schema), row_group_size=len(rows)
        )
        self._entries += len(arrays)
        if self._entries >= PART_ENTRIES:
            self._writer.close()
            self._begin_part()

    def close(self, lost: Mapping[str, int]) -> None:
        """Finish the last part; store the rows lost by mailbox in its metadata."""
        for mailbox in self._waiting:
            self._flush(mailbox)
        self._writer.add_key_value_metadata({"lost": json.dumps(lost)})
        self._writer.close()


@dataclass(frozen=True)
class Column:
    """One field of a mailbox: its path in a message, and its column `<mailbox>.<path>`.

    `shape` is () for a single value, otherwise that of one row's list.
    """

    name: str
    path: tuple[str, ...]
    kind: str
    shape: tuple[int, ...]
    unit: str
    values: tuple[tuple[str, int], ...] = ()  # names and numbers of an enum

    @property
    def field(self) -> pa.Field:
        """The column's Arrow field; shape and unit are in its metadata."""
        element = pa.string() if self.kind[1] == "S" else pa.from_numpy_dtype(np.dtype(self.kind))
        # All rows have the same length, but the nulls of a fixed-size list, in the rows of all
        # other mailboxes, would cost as much memory as values.
        arrow = pa.list_(element) if self.shape else element
        return pa.field(
            self.name, arrow, metadata={"shape": json.dumps(self.shape), "unit": self.unit}
        )

    def of(self, messages: np.ndarray) -> np.ndarray:
        """Return the field in a block of messages, shape (rows, *shape)."""
        for key in self.path:
            messages = messages[key]
        return messages

    def array(self, messages: np.ndarray) -> pa.Array:
        """Return the column of a block of messages, shape (rows,)."""
        flat = np.ascontiguousarray(self.of(messages)).reshape(-1)
        values = pa.array(
            np.strings.decode(flat, "ascii", "replace") if self.kind[1] == "S" else flat
        )
        if not self.shape:
            return values
        offsets = np.arange(len(messages) + 1, dtype=np.int32) * prod(self.shape)
        return pa.ListArray.from_arrays(offsets, values)


def columns_of(mailbox: MailboxSpec) -> list[Column]:
    """Return the columns of a mailbox in the order of its fields; groups of fields are
    flattened."""
    return list(_columns(mailbox.name, (), (), mailbox.fields))


def _columns(
    mailbox: str, path: tuple[str, ...], outer: tuple[int, ...], fields: Sequence[FieldSpec]
) -> Iterator[Column]:
    for field in fields:
        inner = (*path, field.name)
        shape = outer + field.shape
        if field.fields:
            yield from _columns(mailbox, inner, shape, field.fields)
        else:
            name = ".".join((mailbox, *inner))
            yield Column(name, inner, field.kind, shape, field.unit, field.values)

"""The parquet tables of a run.

cycles.parquet is the trace, with one row for each cycle of a task and the same columns for all
tasks. Its metadata contain the layout and the time of the launch.

signals/ has a table for each mailbox that a task or the clock writes, with one row for each
message. Each table is a folder of parts, which parquet readers open as one table, because a long
run has many parts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import prod
from pathlib import Path
from shutil import rmtree

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rack.backplane.json_text import encode_json
from rack.backplane.layout import FieldSpec, Layout, MailboxSpec
from rack.backplane.segment import Launch
from rack.backplane.trace import FIELDS
from rack.tools.recording.cores import CoreRecord

TRACE_FIELDS = (pa.field("task", pa.string()), *(pa.field(name, pa.int64()) for name in FIELDS))
HEAD_COLUMNS = ("serial", "tick", "visible_at", "basis", "stamp_ns", "chain")
"""Columns of every mailbox's messages. In a table they follow `TIME_COLUMN`."""
TIME_COLUMN = "time_s"
"""Column with the simulated time of the tick in s."""
TRACE_ROWS = 1 << 16
MESSAGE_ROWS = 8192
MESSAGE_BYTES = 16 << 20
"""Amounts of buffered rows at which they are written as one block.

Blocks are large because a file's footer has an entry for every column of every block.
"""
SIGNALS = "signals"
TABLE_NAME = "{}.parquet"
PART_NAME = "{:04}.parquet"
PART_ENTRIES = 1 << 12
"""Number of footer entries after which a part is finished.

An open part holds 0.7 kB of memory for each entry.
"""


class CyclesFile:
    """Writer of cycles.parquet, the trace of all tasks.

    Trace records are buffered in memory and written in large blocks.
    """

    def __init__(self, path: Path, layout: Layout, launch: Launch) -> None:
        self._waiting: list[tuple[str, np.ndarray]] = []
        self._waiting_rows = 0
        metadata = {
            "layout": encode_json(asdict(layout)),
            "launch": encode_json(launch),
        }
        self._schema = pa.schema(TRACE_FIELDS, metadata=metadata)
        self._writer = pq.ParquetWriter(
            path,
            self._schema,
            compression="zstd",
            use_dictionary=["task"],
            write_page_checksum=True,
        )

    def add_records(self, task: str, rows: np.ndarray) -> None:
        """Add trace records of a task, shape (rows,)."""
        if len(rows):
            self._waiting.append((task, rows))
            self._waiting_rows += len(rows)
        if self._waiting_rows >= TRACE_ROWS:
            self._write_block()

    def _write_block(self) -> None:
        """Write the buffered records to the file as one block."""
        if not self._waiting:
            return
        # Sort by task, so that the rows of each task are contiguous.
        waiting = sorted(self._waiting, key=lambda block: block[0])
        rows = np.concatenate([block for _, block in waiting])
        names = np.repeat([task for task, _ in waiting], [len(block) for _, block in waiting])
        arrays = [pa.array(names), *(pa.array(np.ascontiguousarray(rows[name])) for name in FIELDS)]
        self._writer.write_batch(
            pa.record_batch(arrays, schema=self._schema), row_group_size=len(rows)
        )
        self._waiting = []
        self._waiting_rows = 0

    def close(
        self,
        lost: Mapping[str, int],
        cores: CoreRecord,
        gaps: Sequence[tuple[str, int, int]],
        kept: Sequence[tuple[int, int]],
    ) -> None:
        """Finish the file. The arguments are stored in its metadata.

        Args:
            lost: Number of lost rows of each task and mailbox.
            cores: Stolen time and frequency of the cores.
            gaps: Name of the ring, first and last tick of each gap.
            kept: Ticks that a flight recorder kept, as ranges [first, end).
        """
        self._write_block()
        metadata = {
            "lost": encode_json(lost),
            "cores": encode_json(asdict(cores)),
            "gaps": encode_json(gaps),
            "kept": encode_json(kept),
        }
        self._writer.add_key_value_metadata(metadata)
        self._writer.close()


def create_signal_tables(folder: Path, layout: Layout) -> dict[str, SignalTable]:
    """Create the tables in signals/. Returns a dictionary from mailbox to table.

    A folder that a killed recorder left behind is deleted first.
    """
    if folder.exists():
        rmtree(folder)
    return {
        mailbox.name: SignalTable(folder / TABLE_NAME.format(mailbox.name), mailbox, layout)
        for mailbox in layout.timed
    }


class SignalTable:
    """Writer of the table of a mailbox, which is a folder of parquet files called parts.

    Rows are buffered in memory and written in large blocks.
    """

    def __init__(self, folder: Path, mailbox: MailboxSpec, layout: Layout) -> None:
        folder.mkdir(parents=True)
        self._folder = folder
        self._tick_s = layout.clock_ns * 1e-9
        self._columns = list_columns(mailbox)
        self._waiting: list[np.ndarray] = []
        self._waiting_rows = 0
        head = [
            pa.field(TIME_COLUMN, pa.float64(), metadata={"unit": "s"}),
            *(
                pa.field(name, pa.uint64() if name == "chain" else pa.int64())
                for name in HEAD_COLUMNS
            ),
        ]
        self._schema = pa.schema([*head, *(column.arrow_field for column in self._columns)])
        self._parts = 0
        self._begin_part()

    def _begin_part(self) -> None:
        """Open the file of the next part."""
        self._parts += 1
        self._entries = 0
        self._writer = pq.ParquetWriter(
            self._folder / PART_NAME.format(self._parts),
            self._schema,
            compression="zstd",
            use_dictionary=[column.label for column in self._columns if column.is_text],
            write_statistics=["tick"],
            write_page_checksum=True,
        )

    def add_rows(self, rows: np.ndarray) -> None:
        """Add rows of the mailbox's ring, at least one, shape (rows,)."""
        self._waiting.append(rows)
        self._waiting_rows += len(rows)
        if self._waiting_rows >= min(MESSAGE_ROWS, MESSAGE_BYTES // rows.itemsize):
            self._write_block()

    def _write_block(self) -> None:
        """Write the buffered rows as one block, and begin a new part if the footer is large."""
        if not self._waiting:
            return
        rows = np.concatenate(self._waiting)
        self._waiting = []
        self._waiting_rows = 0
        head = [np.ascontiguousarray(rows[name]) for name in HEAD_COLUMNS]
        time_s = pa.array(rows["tick"] * self._tick_s)
        arrays = [column.to_arrow(rows["message"]) for column in self._columns]
        self._writer.write_batch(
            pa.record_batch([time_s, *map(pa.array, head), *arrays], schema=self._schema),
            row_group_size=len(rows),
        )
        self._entries += len(self._schema)
        if self._entries >= PART_ENTRIES:
            self._writer.close()
            self._begin_part()

    def close(self) -> None:
        """Write the buffered rows and finish the last part."""
        self._write_block()
        self._writer.close()


@dataclass(frozen=True)
class Column:
    """A field of a mailbox's messages, which is a column of its table.

    Attributes:
        name: Mailbox, groups and field, as in `servo.status.position`.
        mailbox: Name of the mailbox.
        path: Names of the groups of nested fields that contain the field, and of the field itself.
        shape: Shape of the field in a message, () for a single value.
        spec: Declaration of the field.
    """

    name: str
    mailbox: str
    path: tuple[str, ...]
    shape: tuple[int, ...]
    spec: FieldSpec

    @property
    def label(self) -> str:
        """Name of the column in the table, with a prefix if a head column has the same name."""
        name = ".".join(self.path)
        return f"message.{name}" if name in (TIME_COLUMN, *HEAD_COLUMNS) else name

    @property
    def is_text(self) -> bool:
        """True if the field holds text."""
        return self.spec.kind[1] == "S"

    @property
    def arrow_field(self) -> pa.Field:
        """Arrow field of the column, with shape and unit in its metadata."""
        element = pa.string() if self.is_text else pa.from_numpy_dtype(np.dtype(self.spec.kind))
        arrow = pa.list_(element, prod(self.shape)) if self.shape else element
        metadata = {"shape": encode_json(self.shape), "unit": self.spec.unit}
        return pa.field(self.label, arrow, metadata=metadata)

    def extract_values(self, messages: np.ndarray) -> np.ndarray:
        """Return the field's values in an array of messages, as a view of shape (rows, *shape)."""
        for key in self.path:
            messages = messages[key]
        return messages

    def to_arrow(self, messages: np.ndarray) -> pa.Array:
        """Return the field's values in an array of messages as an Arrow array, shape (rows,)."""
        flat = np.ascontiguousarray(self.extract_values(messages)).reshape(-1)
        values = pa.array(np.strings.decode(flat, "ascii", "replace") if self.is_text else flat)
        if not self.shape:
            return values
        return pa.FixedSizeListArray.from_arrays(values, prod(self.shape))


def list_columns(mailbox: MailboxSpec) -> list[Column]:
    """Return the columns of a mailbox in the order of its fields, with nested fields flattened."""
    return list(_flatten_columns(mailbox.name, (), (), mailbox.fields))


def _flatten_columns(
    mailbox: str, path: tuple[str, ...], outer: tuple[int, ...], fields: Sequence[FieldSpec]
) -> Iterator[Column]:
    """Yield the columns of fields, including fields of nested groups.

    Args:
        mailbox: Name of the mailbox.
        path: Names of the groups that contain the fields.
        outer: Shape of these groups, which precedes the shape of the fields.
        fields: The fields.
    """
    for field in fields:
        inner = (*path, field.name)
        shape = outer + field.shape
        if field.fields:
            yield from _flatten_columns(mailbox, inner, shape, field.fields)
        else:
            yield Column(".".join((mailbox, *inner)), mailbox, inner, shape, field)

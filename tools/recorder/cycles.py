"""cycles.parquet: the trace, one row a cycle of a task, with the same columns for all."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rack.backplane.trace import FIELDS
from rack.tools.recorder.steal import Stolen

BLOCK_ROWS = 1 << 16
SCHEMA = pa.schema([pa.field("task", pa.string()), *(pa.field(name, pa.int64()) for name in FIELDS)])


class CyclesFile:
    """Collects trace records and writes them in large blocks."""

    def __init__(self, path: Path) -> None:
        self._waiting: list[tuple[str, np.ndarray]] = []
        self._rows = 0
        self._writer = pq.ParquetWriter(path, SCHEMA, compression="zstd", use_dictionary=["task"])

    def add(self, task: str, rows: np.ndarray) -> None:
        """Take trace records of a task, shape (rows,)."""
        if len(rows):
            self._waiting.append((task, rows))
            self._rows += len(rows)
        if self._rows >= BLOCK_ROWS:
            self._flush()

    def _flush(self) -> None:
        if not self._waiting:
            return
        # Task by task, so that each one's rows stand together.
        waiting = sorted(self._waiting, key=lambda block: block[0])
        rows = np.concatenate([block for _, block in waiting])
        names = np.repeat([task for task, _ in waiting], [len(block) for _, block in waiting])
        arrays = [pa.array(names), *(pa.array(np.ascontiguousarray(rows[name])) for name in FIELDS)]
        self._writer.write_batch(pa.record_batch(arrays, schema=SCHEMA), row_group_size=len(rows))
        self._waiting, self._rows = [], 0

    def close(self, lost: Mapping[str, int], stolen: Sequence[Stolen] = ()) -> None:
        """Write what waits, by task the rows that were lost, and what was stolen from the cores; finish the file."""
        self._flush()
        self._writer.add_key_value_metadata({"lost": json.dumps(lost), "stolen": json.dumps(stolen)})
        self._writer.close()

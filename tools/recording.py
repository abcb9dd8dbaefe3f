"""Reading a recording back: the trace and the signals of one run."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from backplane.layout import Layout, MailboxSpec, TaskSpec
from backplane.trace import RECORD
from tools.answer import Failure


class Recording:
    """A run's folder. Raises `Failure` when it holds no recording."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("config.toml", "cycles.parquet", "signals.parquet"):
            if not (folder / name).is_file():
                raise Failure(f"{folder}: no run, it has no {name}", 2)
        try:
            self._cycles = pq.ParquetFile(folder / "cycles.parquet")
            self._signals = pq.ParquetFile(folder / "signals.parquet")
        except pa.ArrowInvalid as error:
            raise Failure(f"{folder}: its recorder was killed before it could finish: {error}") from error

    @cached_property
    def config(self) -> str:
        """The resolved config, as TOML text."""
        return (self.folder / "config.toml").read_text()

    @cached_property
    def events(self) -> list[dict[str, Any]]:
        """The events of the run, oldest first."""
        path = self.folder / "events.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []

    @cached_property
    def ended(self) -> dict[str, Any]:
        """What was counted at the end of the run, as `tools.running.RunResult`; empty where that is not recorded."""
        return next((event for event in self.events if event["kind"] == "outcome"), {})

    @cached_property
    def layout(self) -> Layout:
        """The rack's layout; the fields of its messages are `signal`'s to know."""
        text = json.loads(self._signals.schema_arrow.metadata[b"layout"])
        boxes = (MailboxSpec(**{**m, "readers": tuple(m["readers"]), "fields": ()}) for m in text["mailboxes"])
        tasks = tuple(TaskSpec(**task) for task in text["tasks"])
        return Layout(text["rack"], text["clock_ns"], tasks, tuple(boxes))

    @cached_property
    def lost(self) -> dict[str, int]:
        """Rows that were overwritten before the recorder came, by task and by mailbox."""
        texts = [file.metadata.metadata[b"lost"] for file in (self._cycles, self._signals)]
        return {name: count for text in texts for name, count in json.loads(text).items()}

    @property
    def columns(self) -> list[str]:
        """The columns of the trace: an earlier rack's has fewer than `backplane.trace.RECORD`."""
        return list(self._cycles.schema_arrow.names)

    @cached_property
    def cycles(self) -> dict[str, np.ndarray]:
        """The trace by task: structured rows, oldest first, with the fields of `backplane.trace.RECORD`."""
        table = self._cycles.read()
        names = table.column_names[1:]
        tasks = table["task"].to_numpy()
        # 0 where an earlier rack has not traced a column.
        rows = np.zeros(len(tasks), dtype=RECORD)
        for name in names:
            rows[name] = table[name].to_numpy()
        return {str(task): rows[tasks == task] for task in dict.fromkeys(tasks)}

    @property
    def no_cycles(self) -> np.ndarray:
        """The trace of a task that has none."""
        return np.empty(0, dtype=RECORD)

    def signal(self, mailbox: str, field: str) -> np.ndarray:
        """Return one field of every message of a mailbox, oldest first, shape (messages, *shape of the field).

        "serial", "tick", "visible_at", "basis", "stamp_ns" and "chain" are fields of every mailbox. Raises `KeyError`.
        """
        schema = self._signals.schema_arrow
        name = field if field in schema.names else f"{mailbox}.{field}"
        column = schema.field(name)
        groups = [group for group in range(self._signals.num_row_groups) if self._mailbox_of(group) == mailbox]
        read = [self._signals.read_row_group(group, columns=[name]).column(0).combine_chunks() for group in groups]
        shape = tuple(json.loads(column.metadata[b"shape"])) if column.metadata else ()
        values = [(block.flatten() if shape else block).to_numpy(zero_copy_only=False) for block in read]
        if not values:
            return np.empty((0, *shape))
        return np.concatenate(values).reshape(-1, *shape)

    def fields(self, mailbox: str) -> set[str]:
        """Return the fields of a mailbox's messages."""
        names = [name for name in self._signals.schema_arrow.names if name.startswith(f"{mailbox}.")]
        return {name.removeprefix(f"{mailbox}.") for name in names}

    @cached_property
    def mailboxes(self) -> list[str]:
        """The mailboxes that were written to."""
        return list(dict.fromkeys(self._mailbox_of(group) for group in range(self._signals.num_row_groups)))

    def _mailbox_of(self, group: int) -> str:
        # Rows of one mailbox alone stand in a row group: its smallest name is its only one.
        return str(self._signals.metadata.row_group(group).column(0).statistics.min)

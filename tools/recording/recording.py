"""Reads a recorded run: its trace, signals and events."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import TypeAdapter

from rack.backplane.layout import TaskSpec
from rack.backplane.mailbox.history import build_row_dtype
from rack.backplane.segment import Launch, Segment, restore_layout
from rack.backplane.trace import FIELDS, RECORD
from rack.boards.config import RackConfig, read_stored
from rack.boards.config.published import PublishedRack
from rack.boards.errors import ConfigError
from rack.boards.events import Event, get_event_order
from rack.tools.console.answer import Document, Failure
from rack.tools.recording.checksums import (
    CHECKSUMS,
    Checksums,
    is_cut_off,
    parse_checked_line,
    read_file,
)
from rack.tools.recording.cores import CoreRecord
from rack.tools.recording.file_names import CONFIG, PUBLISHED
from rack.tools.recording.parquet import HEAD_COLUMNS, PART_NAME, SIGNALS, TABLE_NAME, list_columns
from rack.tools.recording.run_files import CYCLES, EVENTS, MissingRows, find_missing, rebuild_files
from rack.tools.recording.spool import STRETCHES, open_rings


class Gap(NamedTuple):
    """A range of ticks in which a recording lacks rows.

    Attributes:
        first: First tick.
        last: Last tick.
        rings: Tasks and mailboxes whose rows are missing.
    """

    first: int
    last: int
    rings: tuple[str, ...]

    def __str__(self) -> str:
        """Return the gap as a clause for messages to the user."""
        more = f" and {len(self.rings) - 3} more" if len(self.rings) > 3 else ""
        return (
            f"ticks {self.first:,} to {self.last:,} of {', '.join(self.rings[:3])}{more} are not"
            " recorded"
        )


MAX_SHOWN_STRETCHES = 20
"""Largest number of kept stretches that a text lists."""
READ_ERRORS = (pa.ArrowException, OSError, ValueError, KeyError, TypeError)
"""Errors that reading a damaged file, or a file of another format, may raise."""


class Recording:
    """A recorded run, read from its folder.

    If the recorder was killed, or was a flight recorder, the parquet files are first built from its
    spool. Any method raises `Failure` if a file that it reads is missing or damaged.

    A flight recorder keeps only some ranges of ticks, called stretches.

    Attributes:
        folder: Folder of the run.
        checksums: Checksums of the files in the folder.
        config: The resolved config, as TOML text.
        layout: Layout of the rack.
        launch: Time of the rack's launch.
        cores: Stolen time and frequency of the cores. Empty if the recorder did not measure them or
            was killed.
        kept: Ticks that a flight recorder kept, as ranges [first, end). Empty if it removed
            nothing.
        events: The events of the run sorted by tick, then its outcome.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._require_file(CONFIG)
        with _convert_read_errors(folder):
            is_flight = (folder / STRETCHES).is_dir()
            if rebuild_files(folder) and not is_flight:
                print(
                    f"{folder}: its recorder was killed; the rows it had taken are now in"
                    " cycles.parquet and signals",
                    file=sys.stderr,
                )
        self._require_file(CHECKSUMS)
        self.checksums = Checksums(folder)
        self.checksums.verify(CONFIG)
        self.config = self._read_text(CONFIG)
        path = self._require_file(CYCLES)
        self._cycles = self._open_parquet(path, ("task", *FIELDS))
        with _convert_read_errors(path):
            metadata = self._cycles.metadata.metadata
            self.layout = restore_layout(json.loads(metadata[b"layout"]))
            self.launch = Launch(*json.loads(metadata[b"launch"]))
            self.cores = TypeAdapter(CoreRecord).validate_json(metadata[b"cores"])
            kept = [tuple(ends) for ends in json.loads(metadata[b"kept"])]
            self.kept: list[tuple[int, int]] = [] if len(kept) == 1 and kept[0][0] == 0 else kept
            self._gaps = json.loads(metadata[b"gaps"])
            self._lost_before_end = dict[str, int](json.loads(metadata[b"lost"]))
        self._shapes = {
            box.name: {column.label: column.shape for column in list_columns(box)}
            for box in self.layout.mailboxes
        }
        self._tables = {box.name: self._open_table(box.name) for box in self.layout.timed}
        self.events = self._read_events()

    @cached_property
    def rack_config(self) -> RackConfig:
        """The resolved config. If it is invalid, raises `Failure` with a list of all mistakes."""
        try:
            return read_stored(self.config)
        except ConfigError as error:
            mistakes = "; ".join(str(error).splitlines())
            raise Failure(f"{self.folder / 'config.toml'}: {mistakes}", 2) from None

    def register_fault_kinds(self) -> None:
        """Register the fault kinds that the rack's own levels define.

        Raises:
            Failure: published.json, which describes the fault kinds, is damaged.
        """
        path = self.folder / PUBLISHED
        if path.exists():
            self.checksums.verify(PUBLISHED)
            with _convert_read_errors(path):
                PublishedRack.read(self._read_text(PUBLISHED))

    def _open_table(self, mailbox: str) -> list[pq.ParquetFile]:
        """Open the parts of a mailbox's table, oldest first."""
        # Every table has a first part.
        folder = f"{SIGNALS}/{TABLE_NAME.format(mailbox)}/"
        stored = {name for name in self.checksums.stored if name.startswith(folder)}
        columns = (*HEAD_COLUMNS, *self._shapes[mailbox])
        return [
            self._open_parquet(self.folder / name, columns)
            for name in sorted({*stored, folder + PART_NAME.format(1)})
        ]

    def _open_parquet(self, path: Path, columns: Iterable[str]) -> pq.ParquetFile:
        """Open a parquet file.

        Raises:
            Failure: The file is damaged, or lacks one of these columns.
        """
        self.checksums.verify(str(path.relative_to(self.folder)))
        with _convert_read_errors(path):
            file = pq.ParquetFile(path, page_checksum_verification=True)
        names = file.schema_arrow.names
        if missing := [column for column in columns if column not in names]:
            raise Failure(f"{path}: not a recording of a rack: it has no column '{missing[0]}'", 2)
        return file

    def _read_text(self, name: str) -> str:
        """Read a text file of the run. Raises `Failure` if it is missing or not text."""
        path = self._require_file(name)
        with _convert_read_errors(path):
            return read_file(path).decode()

    def _require_file(self, name: str) -> Path:
        """Return the path of a file that every run has. Raises `Failure` if it is missing."""
        if not (self.folder / name).exists():
            raise Failure(f"{self.folder}: not a run: it has no {name}", 2)
        return self.folder / name

    def _read_events(self) -> list[Document]:
        """Read the events of the run, sorted by tick. Returns [] if no events were recorded."""
        path = self.folder / EVENTS
        if not path.exists():
            return []
        *lines, last = self._read_text(EVENTS).split("\n")
        if last and is_cut_off(last):
            # A killed run can leave an incomplete last line.
            print(f"{path}: line {len(lines) + 1} is cut off, and left out", file=sys.stderr)
        elif last:
            lines.append(last)
        events = (
            _parse_event(line, f"{path}: line {number}") for number, line in enumerate(lines, 1)
        )
        return sorted(events, key=get_event_order)

    @cached_property
    def end_counts(self) -> Document:
        """Counts at the end of the run, as in `rack.tools.launch.launch.RunResult`.

        Empty if the end was not recorded.
        """
        return next((event for event in self.events if event["kind"] == "outcome"), {})

    @property
    def lost_rows(self) -> dict[str, int]:
        """Number of rows of each task and mailbox that were written but are not in the files."""
        return dict(self.end_counts.get("rows_lost", self._lost_before_end))

    def find_stretches(self, ticks: np.ndarray) -> np.ndarray:
        """Return the index of the kept stretch that contains each tick, shape (n,).

        Do not compute differences between rows of different stretches, because nothing is recorded
        between them. If everything was kept, all indices are 0.
        """
        # Rows may lie slightly outside their stretch. Each border between two stretches is
        # therefore halfway between them, but at most one second after the earlier one.
        second = self.layout.to_ticks(1.0)
        borders = [
            end + min((first - end) // 2, second) for (_, end), (first, _) in pairwise(self.kept)
        ]
        return np.searchsorted(borders, ticks, side="right")

    @property
    def kept_text(self) -> str:
        """Sentence that says which stretches were kept, or "" if everything was kept."""
        tick_s = self.layout.clock_ns * 1e-9
        spans = [f"{first * tick_s:.1f} s to {end * tick_s:.1f} s" for first, end in self.kept]
        more = (
            [f"{len(spans) - MAX_SHOWN_STRETCHES} more stretches"]
            if len(spans) > MAX_SHOWN_STRETCHES
            else []
        )
        text = " and ".join([*spans[:MAX_SHOWN_STRETCHES], *more])
        return f"kept {text}; the rest was not kept, as [record] keep says" if text else ""

    def find_gaps(self, lost: Mapping[str, int] | None = None, ticks: int = 0) -> list[Gap]:
        """Find the ranges of ticks in which rows are missing. Overlapping ranges are merged.

        Args:
            lost: Number of lost rows of each task and mailbox. Defaults to the counts at the end of
                the run.
            ticks: Length of the run in ticks, if `lost` is given. If `lost` counts more rows of a
                ring than the files report, the additional rows are assumed to be missing between
                the last recorded row of the ring and this tick.
        """
        if lost is None:
            lost, ticks = self.lost_rows, self.end_counts.get("outcome", {}).get("ticks", 0)
        gaps = list(self._gaps)
        for name, count in lost.items():
            if count > self._lost_before_end.get(name, 0):
                gaps.append((name, self._find_last_tick(name) + 1, ticks - 1))
        merged: list[Gap] = []
        # If only the row of the last tick is missing, `first` is after `last`.
        for ring, first, last in sorted(
            ((name, min(first, last), last) for name, first, last in gaps), key=lambda gap: gap[1]
        ):
            if merged and first <= merged[-1].last + 1:
                previous = merged.pop()
                rings = tuple(dict.fromkeys((*previous.rings, ring)))
                merged.append(Gap(previous.first, max(previous.last, last), rings))
            else:
                merged.append(Gap(first, last, (ring,)))
        return merged

    def _find_last_tick(self, name: str) -> int:
        """Return the tick of the newest row of a task or mailbox, or -1 if it has none."""
        if name in self.cycles:
            return int(self.cycles[name]["tick"][-1])
        return int(self.read_signal(name, "tick")[-1]) if name in self.mailboxes else -1

    def count_traced_cycles(self) -> dict[str, tuple[int, int]]:
        """Count the cycles of each task that lacks trace records.

        Returns:
            Dictionary from task to its recorded and its total number of cycles.
        """
        traced = {task.name: len(self.read_trace(task.name)) for task in self.layout.tasks}
        return {
            name: (rows, rows + self.lost_rows[name])
            for name, rows in traced.items()
            if self.lost_rows.get(name)
        }

    def count_missing_rows(self, segment: Segment) -> dict[str, MissingRows]:
        """Count the rows of the rack's rings that are missing from the files.

        Call this only when the rack has ended.

        Args:
            segment: Segment of the rack.

        Returns:
            Dictionary from task or mailbox to its missing rows. Complete rings are left out.
        """
        taken = {}
        lost = dict(self.lost_rows)
        for name, ring in open_rings(segment).items():
            if name in self.cycles:
                taken[name] = ring.before + lost[name] + len(self.cycles[name])
            else:
                serials = self.read_signal(name, "serial")
                taken[name] = int(serials[-1]) if len(serials) else ring.before
                # Rows missing before the last serial were lost, or skipped as damaged. Count only
                # lost rows. Rows lost after the last serial are counted from the ring itself.
                lost[name] = min(lost[name], taken[name] - ring.before - len(serials))
        return find_missing(segment, taken, lost)

    @cached_property
    def cycles(self) -> dict[str, np.ndarray]:
        """Trace records of each task, of type `rack.backplane.trace.RECORD`, oldest first."""
        with _convert_read_errors(self.folder / CYCLES):
            table = self._cycles.read()
            tasks = table["task"].to_numpy()
            rows = np.empty(len(tasks), dtype=RECORD)
            for name in FIELDS:
                rows[name] = table[name].to_numpy()
        return {str(task): rows[tasks == task] for task in dict.fromkeys(tasks)}

    def find_task_counts(self, task: str) -> Document:
        """Return the counts of a task at the end of the run. Empty if the end was not recorded."""
        return dict(self.end_counts.get("tasks", {}).get(task, {}))

    def find_core_and_priority(self, task: TaskSpec) -> tuple[int, int]:
        """Return the core and the priority with which a task ran.

        If the end of the run was not recorded, the values are taken from the config.
        """
        counted = self.find_task_counts(task.name)
        return counted.get("core", task.core), counted.get("priority", task.priority)

    def read_trace(self, task: str) -> np.ndarray:
        """Return the trace records of a task, as in `cycles`. Empty if it has none."""
        return self.cycles.get(task, np.empty(0, dtype=RECORD))

    def read_signal(self, mailbox: str, field: str) -> np.ndarray:
        """Return one field of all messages of a mailbox.

        Args:
            mailbox: The mailbox.
            field: Name of the field. Every mailbox has the fields "serial", "tick", "visible_at",
                "basis", "stamp_ns" and "chain". If a message declares a field with one of these
                names, that field is called "message.<name>".

        Returns:
            Values, oldest first, shape (messages, *shape of the field).

        Raises:
            KeyError: The messages have no such field.
        """
        shape = () if field in HEAD_COLUMNS else self._shapes[mailbox][field]
        with _convert_read_errors(self.folder / SIGNALS / TABLE_NAME.format(mailbox)):
            tables = [file.read(columns=[field]) for file in self._tables.get(mailbox, ())]
        if not any(map(len, tables)):
            return np.empty((0, *shape))
        column = pa.concat_tables(tables).column(0).combine_chunks()
        values = column.flatten() if shape else column
        return np.asarray(values.to_numpy(zero_copy_only=False).reshape(-1, *shape))

    def read_rows(self, name: str) -> np.ndarray:
        """Return the recorded rows of a task (trace records) or of a mailbox, oldest first."""
        if name in self.cycles:
            return self.cycles[name]
        box = self.layout.find_mailbox(name)
        rows = np.zeros(len(self.read_signal(name, "tick")), build_row_dtype(box))
        for field in HEAD_COLUMNS:
            rows[field] = self.read_signal(name, field)
        for column in list_columns(box):
            column.extract_values(rows["message"])[...] = self.read_signal(name, column.label)
        return rows

    def list_fields(self, mailbox: str) -> set[str]:
        """Return the names of all fields of a mailbox's messages."""
        return {*self._shapes[mailbox]}

    @property
    def mailboxes(self) -> list[str]:
        """Names of the mailboxes with at least one recorded message."""
        tables = self._tables.items()
        return [name for name, parts in tables if any(part.metadata.num_rows for part in parts)]


@contextmanager
def _convert_read_errors(path: Path) -> Iterator[None]:
    """Convert an error while reading a file to a `Failure` that names the file."""
    try:
        yield
    except READ_ERRORS as error:
        raise Failure(
            f"{path}: not readable as a recording: {' '.join(str(error).split()) or error!r}", 2
        ) from None


def _parse_event(line: str, place: str) -> Document:
    """Parse a line of events.jsonl.

    Raises:
        Failure: The line is damaged or not an event. The message begins with `place`, the file
            and line that are parsed.
    """
    try:
        event = parse_checked_line(line)
        if event["kind"] == "outcome":
            {**event["outcome"], **event["tasks"]}
        else:
            Event(**event)
            int(event["tick"])
    except (ValueError, TypeError, KeyError) as error:
        raise Failure(f"{place}: not an event of a run: {error or error!r}", 2) from None
    return dict(event)

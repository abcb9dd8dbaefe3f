"""A recording, read back: the trace, the signals and the events of one run."""

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

from rack.backplane.layout import TaskSpec
from rack.backplane.mailbox.history import row_dtype
from rack.backplane.message import printable
from rack.backplane.segment import Launch, Segment, layout_of
from rack.backplane.trace import FIELDS, RECORD
from rack.boards.config import RackConfig, read_stored
from rack.boards.config.published import PublishedRack
from rack.boards.errors import ConfigError
from rack.boards.events import Event, order_key
from rack.tools.console.answer import Document, Failure
from rack.tools.recording.checksums import (
    CHECKSUMS,
    Checksums,
    is_cut_off,
    read_file,
    read_line,
)
from rack.tools.recording.cores import CoreRecord
from rack.tools.recording.file_names import CONFIG, PUBLISHED
from rack.tools.recording.parquet import HEAD, PART, SIGNALS, TABLE, columns_of
from rack.tools.recording.run_files import CYCLES, EVENTS, Missing, find_missing, mend
from rack.tools.recording.spool import STRETCHES, rings


class Gap(NamedTuple):
    """Ticks of which a recording lacks rows, from the first to the last, and of which tasks and
    mailboxes.
    """

    first: int
    last: int
    rings: tuple[str, ...]

    def __str__(self) -> str:
        """Return it as text."""
        more = f" and {len(self.rings) - 3} more" if len(self.rings) > 3 else ""
        return (
            f"ticks {self.first:,} to {self.last:,} of {', '.join(self.rings[:3])}{more} are not"
            " recorded"
        )


SHOWN = 20
"""Stretches of which a text says from when to when they are."""
UNREADABLE = (pa.ArrowException, OSError, ValueError, KeyError, TypeError)
"""Errors of reading a damaged file, or a file of another kind."""


class Recording:
    """The folder of a run. Every part raises `Failure`, with the file and its fault, when it cannot
    be read.

    The spool of a recorder that was killed is first turned into readable files, with a note on
    stderr; so are the stretches that a flight recorder kept.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._there(CONFIG)
        with _naming(folder):
            is_flight = (folder / STRETCHES).is_dir()
            if mend(folder) and not is_flight:
                _note(
                    f"{folder}: its recorder was killed; what it had taken is in cycles.parquet and"
                    " signals"
                )
        self._there(CHECKSUMS)
        self.checksums = Checksums(folder)
        self.checksums.verify(CONFIG)
        self.config = self._text(CONFIG)
        """The resolved config, as TOML text."""
        path = self._there(CYCLES)
        self._cycles = self._opened(path, ("task", *FIELDS))
        with _naming(path):
            metadata = self._cycles.metadata.metadata
            self.layout = layout_of(json.loads(metadata[b"layout"]))
            """The rack's layout."""
            self.launch = Launch(*json.loads(metadata[b"launch"]))
            """When the rack was launched."""
            self.cores = CoreRecord.of(metadata[b"cores"])
            """What the machine did to its cores; empty if the recorder did not measure it, or was
            killed."""
            kept = [tuple(ends) for ends in json.loads(metadata[b"kept"])]
            self.kept: list[tuple[int, int]] = [] if len(kept) == 1 and kept[0][0] == 0 else kept
            """The ticks of the stretches that a flight recorder kept, [first, end); none if it
            removed nothing."""
            self._gaps = json.loads(metadata[b"gaps"])
            self._lost_before_the_end = dict[str, int](json.loads(metadata[b"lost"]))
        self._shapes = {
            box.name: {column.label: column.shape for column in columns_of(box)}
            for box in self.layout.mailboxes
        }
        self._tables = {box.name: self._parts(box.name) for box in self.layout.timed}
        self.events = self._read_events()
        """The events of the run by tick, then its outcome."""

    @cached_property
    def rack_config(self) -> RackConfig:
        """The resolved config. Raises `Failure` with every mistake in it."""
        try:
            return read_stored(self.config)
        except ConfigError as error:
            mistakes = "; ".join(str(error).splitlines())
            raise Failure(f"{self.folder / 'config.toml'}: {mistakes}", 2) from None

    def adopt_kinds(self) -> None:
        """Let this process know the kinds of faults that the rack's own levels add. Raises
        `Failure`.
        """
        path = self.folder / PUBLISHED
        if path.exists():
            self.checksums.verify(PUBLISHED)
            with _naming(path):
                PublishedRack.read(self._text(PUBLISHED))

    def _parts(self, mailbox: str) -> list[pq.ParquetFile]:
        """Return the parts of a mailbox's table, oldest first."""
        path = self._there(f"{SIGNALS}/{TABLE.format(mailbox)}")
        with _naming(path):
            count = max(len([*path.iterdir()]), 1)
        parts = [path / PART.format(number) for number in range(1, count + 1)]
        if absent := [part.name for part in parts if not part.exists()]:
            raise Failure(f"{path}: {absent[0]} is missing", 2)
        return [self._opened(part, (*HEAD, *self._shapes[mailbox])) for part in parts]

    def _opened(self, path: Path, columns: Iterable[str]) -> pq.ParquetFile:
        """Return an undamaged parquet file that has these columns. Raises `Failure`."""
        self.checksums.verify(str(path.relative_to(self.folder)))
        with _naming(path):
            file = pq.ParquetFile(path, page_checksum_verification=True)
        names = file.schema_arrow.names
        if absent := [column for column in columns if column not in names]:
            raise Failure(f"{path}: not a recording of a rack: it has no column '{absent[0]}'", 2)
        return file

    def _text(self, name: str) -> str:
        path = self._there(name)
        try:
            return read_file(path).decode()
        except UnicodeDecodeError as error:
            raise Failure(
                f"{path}: not text: byte {error.start} is 0x{error.object[error.start]:02x}", 2
            ) from None

    def _there(self, name: str) -> Path:
        if not (self.folder / name).exists():
            raise Failure(f"{self.folder}: not a run: it has no {name}", 2)
        return self.folder / name

    def _read_events(self) -> list[Document]:
        path = self.folder / EVENTS
        if not path.exists():
            return []
        *lines, last = self._text(EVENTS).split("\n")
        if last and is_cut_off(last):
            # A run that was killed leaves half a line.
            _note(f"{path}: line {len(lines) + 1} is cut off, and left out")
        elif last:
            lines.append(last)
        found = (_event(line, f"{path}: line {number}") for number, line in enumerate(lines, 1))
        return sorted(found, key=order_key)

    @cached_property
    def ended(self) -> Document:
        """Counts at the end of the run, as in `rack.tools.launch.launch.RunResult`. Empty if they
        are not recorded.
        """
        return next((event for event in self.events if event["kind"] == "outcome"), {})

    @property
    def lost(self) -> dict[str, int]:
        """Rows that were written and are not in the files, by task and by mailbox."""
        return dict(self.ended.get("rows_lost", self._lost_before_the_end))

    def stretch_of(self, ticks: np.ndarray) -> np.ndarray:
        """Return the number of the stretch of each tick, shape (n,): what lies between two of them
        is unknown. All are of one where everything was kept.
        """
        # Some rows are later than the end of their stretch, or of releases before its begin.
        second = round(1e9 / self.layout.clock_ns)
        borders = [
            end + min((first - end) // 2, second) for (_, end), (first, _) in pairwise(self.kept)
        ]
        return np.searchsorted(borders, ticks, side="right")

    @property
    def kept_text(self) -> str:
        """It as text; empty if nothing was removed."""
        tick_s = self.layout.clock_ns * 1e-9
        spans = [f"{first * tick_s:.1f} s to {end * tick_s:.1f} s" for first, end in self.kept]
        more = [f"{len(spans) - SHOWN} more stretches"] if len(spans) > SHOWN else []
        text = " and ".join([*spans[:SHOWN], *more])
        return f"kept {text}; the rest was not kept, as [record] keep says" if text else ""

    def gaps(self, lost: Mapping[str, int] | None = None, ticks: int | None = None) -> list[Gap]:
        """Return where rows are missing, in order; gaps that overlap are one.

        `lost` (default: as known at the end) counts them by ring, for a run of `ticks`: what the
        files do not know of was lost after their last row.
        """
        lost = self.lost if lost is None else lost
        ticks = self.ended.get("outcome", {}).get("ticks", 0) if ticks is None else ticks
        found = list(self._gaps)
        for name, count in lost.items():
            if count > self._lost_before_the_end.get(name, 0):
                found.append((name, self._last_tick(name) + 1, ticks - 1))
        merged: list[Gap] = []
        # A row of the last tick itself may be missing: there is no tick after it.
        for ring, first, last in sorted(
            ((name, min(first, last), last) for name, first, last in found), key=lambda gap: gap[1]
        ):
            if merged and first <= merged[-1].last + 1:
                before = merged.pop()
                rings = tuple(dict.fromkeys((*before.rings, ring)))
                merged.append(Gap(before.first, max(before.last, last), rings))
            else:
                merged.append(Gap(first, last, (ring,)))
        return merged

    def _last_tick(self, name: str) -> int:
        """Return the tick of the newest row of a task or mailbox; -1 if there is none."""
        if name in self.cycles:
            return int(self.cycles[name]["tick"][-1])
        return int(self.signal(name, "tick")[-1]) if name in self.mailboxes else -1

    def untraced(self) -> dict[str, tuple[int, int]]:
        """Return the tasks with cycles that are not recorded: how many are, and of how many."""
        traced = {task.name: len(self.trace(task.name)) for task in self.layout.tasks}
        return {
            name: (rows, rows + self.lost[name])
            for name, rows in traced.items()
            if self.lost.get(name)
        }

    def missing(self, segment: Segment) -> dict[str, Missing]:
        """Return what the files lack of the rings of a rack that has ended, by task and by
        mailbox.
        """
        taken = {}
        lost = dict(self.lost)
        for name, ring in rings(segment).items():
            if name in self.cycles:
                taken[name] = ring.before + lost[name] + len(self.cycles[name])
            else:
                serials = self.signal(name, "serial")
                taken[name] = int(serials[-1]) if len(serials) else ring.before
                # Messages that every reader rejects are absent and not lost; those lost last are
                # overwritten.
                lost[name] = min(lost[name], taken[name] - ring.before - len(serials))
        return find_missing(segment, taken, lost)

    @cached_property
    def cycles(self) -> dict[str, np.ndarray]:
        """The trace by task: structured rows, oldest first, with the fields of
        `rack.backplane.trace.RECORD`.
        """
        with _naming(self.folder / CYCLES):
            table = self._cycles.read()
            tasks = table["task"].to_numpy()
            rows = np.empty(len(tasks), dtype=RECORD)
            for name in FIELDS:
                rows[name] = table[name].to_numpy()
        return {str(task): rows[tasks == task] for task in dict.fromkeys(tasks)}

    def counts(self, task: str) -> Document:
        """Return the counts of a task at the end of the run; empty where they are not recorded."""
        return dict(self.ended.get("tasks", {}).get(task, {}))

    def place(self, task: TaskSpec) -> tuple[int, int]:
        """Return core and priority that a task obtained; those of the config where the run's end is
        not recorded.
        """
        counted = self.counts(task.name)
        return counted.get("core", task.core), counted.get("priority", task.priority)

    def trace(self, task: str) -> np.ndarray:
        """Return the trace of a task, as in `cycles`; empty for a task that left none."""
        return self.cycles.get(task, np.empty(0, dtype=RECORD))

    def signal(self, mailbox: str, field: str) -> np.ndarray:
        """Return one field of every message of a mailbox, oldest first, shape (messages, *shape of
        the field).

        "serial", "tick", "visible_at", "basis", "stamp_ns" and "chain" are fields of every mailbox;
        a field of its own with such a name is "message.<name>". Raises `KeyError`.
        """
        shape = () if field in HEAD else self._shapes[mailbox][field]
        with _naming(self.folder / SIGNALS / TABLE.format(mailbox)):
            read = [file.read(columns=[field]) for file in self._tables.get(mailbox, ())]
        if not any(map(len, read)):
            return np.empty((0, *shape))
        column = pa.concat_tables(read).column(0).combine_chunks()
        values = column.flatten() if shape else column
        return np.asarray(values.to_numpy(zero_copy_only=False).reshape(-1, *shape))

    def reason(self, mailbox: str, row: int) -> str:
        """Return the reason in a status, for people; empty for one of a user's level without
        one.
        """
        has_reason = "reason" in self.fields(mailbox)
        return printable(str(self.signal(mailbox, "reason")[row])) if has_reason else ""

    def rows(self, name: str) -> np.ndarray:
        """Return what a recorder took from a ring, oldest first: trace records of a task, or
        messages of a mailbox.
        """
        if name in self.cycles:
            return self.cycles[name]
        box = self.layout.mailbox(name)
        found = np.zeros(len(self.signal(name, "tick")), row_dtype(box))
        for field in HEAD:
            found[field] = self.signal(name, field)
        for column in columns_of(box):
            column.values(found["message"])[...] = self.signal(name, column.label)
        return found

    def fields(self, mailbox: str) -> set[str]:
        """Return the fields of a mailbox's messages."""
        return {*self._shapes[mailbox]}

    @property
    def mailboxes(self) -> list[str]:
        """The mailboxes that hold messages."""
        tables = self._tables.items()
        return [name for name, parts in tables if any(part.metadata.num_rows for part in parts)]


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Turn an error of reading into a `Failure` that names the file."""
    try:
        yield
    except UNREADABLE as error:
        raise Failure(
            f"{path}: not readable as a recording: {' '.join(str(error).split()) or error!r}", 2
        ) from None


def _event(line: str, place: str) -> Document:
    """Return an event from its line, as `read_line` does. Raises `Failure`, which names the
    place.
    """
    try:
        event = read_line(line)
        if event["kind"] == "outcome":
            {**event["outcome"], **event["tasks"]}
        else:
            Event(**event)
            int(event["tick"])
    except (ValueError, TypeError, KeyError) as error:
        raise Failure(f"{place}: not an event of a run: {error or error!r}", 2) from None
    return dict(event)


def _note(text: str) -> None:
    print(text, file=sys.stderr)

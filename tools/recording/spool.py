"""The spool, which protects a recording: a parquet file is unreadable until its footer is written.

About ten times a second the recorder appends the rows of all rings, compressed, to
`recorder.spool`. Each append is a line of JSON with its own checksum, as in events.jsonl. A
restarted recorder continues from the spool, and `rebuild_files` makes the parquet files from the
spool of a recorder that was killed. The spool is removed when the files are complete. A truncated
last line is dropped; any other damage is an error. The rings hold two seconds, so nothing is lost
if a recorder is restarted within that time.

Arrow's IPC streams were rejected: a stream of columns for each ring takes six times the processor
time, and streams have no checksums, so damaged data could be read as other values.

A flight recorder (`[record] keep`) writes no parquet files. It writes the rows to files called
stretches, each for a range of ticks, and deletes stretches that are not near an occasion. The head
of each stretch contains the counts of everything before it, so the parquet files can be built even
though stretches are missing. They are built when the run is opened; ten minutes of the NASREM rack
take 20 s.
"""

from __future__ import annotations

import fcntl
import time
from base64 import b64decode, b64encode
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import pyarrow as pa

from rack.backplane.layout import Layout
from rack.backplane.mailbox.history import MailboxRing, build_row_dtype
from rack.backplane.ring import Ring
from rack.backplane.segment import Launch, Segment, restore_layout
from rack.backplane.trace import RECORD, open_trace_ring
from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import (
    Checksums,
    check_file,
    format_checked_line,
    is_cut_off,
    parse_checked_line,
)
from rack.tools.recording.file_names import CODE, CONFIG, JOINED, ORIGIN, SPOOL

FLUSH_S = 0.1
"""Time between two writes of the spool.

If all processes are killed, the rows that boards wrote in this time are lost, together with those
written between two drains and during one or two passes of the recorder. A pass lasts longer on a
busy machine.
"""
STRETCHES = "stretches"
OPEN_END = -1
"""End of a stretch that is still being written, or whose recorder was killed."""


class SpoolHead(NamedTuple):
    """First line of a spool: the rack's layout as plain data, and the time of its launch."""

    layout: Any
    launch: Launch


class Frame(NamedTuple):
    """A line of a spool with rows that were read from the rings in one or more passes.

    Attributes:
        counts: Ring, number of rows, and number of rows lost before them, for each block of rows.
        data: Rows of all blocks in order, compressed, as base64.
    """

    counts: list[tuple[str, int, int]]
    data: str

    def unpack_rows(self, dtypes: Mapping[str, np.dtype]) -> Iterator[tuple[str, np.ndarray, int]]:
        """Yield the blocks of rows.

        Args:
            dtypes: Row type of every ring, from `list_ring_dtypes`.

        Yields:
            Name of the ring, its rows of shape (rows,), and number of rows lost before them.
        """
        sizes = [length * dtypes[ring].itemsize for ring, length, _ in self.counts]
        data = pa.decompress(b64decode(self.data), sum(sizes), "zstd", asbytes=True)
        offset = 0
        for (ring, length, lost), size in zip(self.counts, sizes, strict=True):
            yield ring, np.frombuffer(data, dtypes[ring], length, offset), lost
            offset += size


class StretchHead(NamedTuple):
    """First line of a stretch, a file for a range of ticks.

    Attributes:
        number: Number of the stretch, counted from 1.
        begin: First tick of the range. The stretch contains rows of cycles that ended at or after
            this tick.
        taken: Number of the last record that was read from each ring before the stretch.
        rows: Number of rows that were read from each ring before the stretch.
    """

    number: int
    begin: int
    taken: dict[str, int]
    rows: dict[str, int]


class StretchEnd(NamedTuple):
    """Last line of a stretch, which a killed recorder does not write.

    Attributes:
        tick: Tick after the range. The stretch contains rows of cycles that ended before this tick.
    """

    tick: int


Part = StretchHead | Frame | StretchEnd
PART_TYPES = {kind.__name__: kind for kind in (SpoolHead, StretchHead, Frame, StretchEnd)}


class Spool:
    """The spool in the folder of a run, open for writing.

    The spool protects rows until the parquet files are complete. It consists of lines called parts:
    frames with rows and, for a flight recorder, heads and ends of stretches, which are separate
    files. Before adding rows, call `read_rest` to continue the spool of an earlier recorder.

    Raises `Failure` if another recorder has the spool open, or if it belongs to another launch or
    rack.
    """

    def __init__(self, folder: Path, layout: Layout, launch: Launch) -> None:
        self.path = folder / SPOOL
        # Unbuffered, so that the kernel has everything that was written if this process is killed.
        self._file = self.path.open("ab", buffering=0)
        self._out: IO[bytes] = self._file
        self._folder = folder
        self._waiting: list[tuple[str, np.ndarray, int]] = []
        self._flush_at = 0.0
        try:
            if not try_lock(self._file):
                raise Failure(f"{self.path}: another recorder is still writing it")
            if not self.path.stat().st_size:
                # The launcher has written these files before it starts the recorder.
                Checksums(folder).store(CONFIG, ORIGIN, CODE, JOINED)
                _write_part(self._file, SpoolHead(asdict(layout), launch))
            with self.path.open("rb") as file:
                recorded_head = read_head(file, self.path)
            if recorded_head != (layout, launch):
                raise Failure(
                    f"{self.path}: holds a recording of another launch or rack,"
                    f" '{recorded_head[0].rack}'"
                )
        except BaseException:
            self.close()
            raise

    def read_rest(self) -> Iterator[Part]:
        """Yield the parts that an earlier recorder wrote, and cut off an incomplete last line.

        Of a flight recorder's stretches, only the last two are read.
        """
        with self.path.open("rb") as file:
            read_head(file, self.path)
            complete_bytes = file.tell()
            for part in _read_parts(file, self.path):
                yield part
                complete_bytes = file.tell()
        self._file.truncate(complete_bytes)
        # The head of a stretch contains all counts before it, so the last stretch would suffice.
        # Its head may be incomplete, so read the last two.
        yield from _read_stretches(list_stretch_files(self._folder)[-2:])

    def begin_stretch(self, stretch: StretchHead, end: int) -> Path:
        """Finish the current stretch, and write all further rows to a new stretch.

        Args:
            stretch: Head of the new stretch.
            end: Tick after the last tick of the current stretch.

        Returns:
            Path of the new stretch.
        """
        self.flush(now=True)
        self._finish_stretch(end)
        path = self._folder / STRETCHES / f"{stretch.number:08}.spool"
        path.parent.mkdir(exist_ok=True)
        self._out = path.open("wb", buffering=0)
        _write_part(self._out, stretch)
        return path

    def _finish_stretch(self, end: int) -> None:
        """Write the end of the current stretch, unless it is `OPEN_END`, and close its file."""
        if self._out is not self._file:
            if end != OPEN_END:
                _write_part(self._out, StretchEnd(end))
            self._out.close()

    def add_rows(self, ring: str, rows: np.ndarray, lost: int) -> None:
        """Queue rows of a ring for the next flush.

        Args:
            ring: Name of the ring.
            rows: The rows, shape (rows,).
            lost: Number of rows lost before these rows.
        """
        if len(rows) or lost:
            self._waiting.append((ring, rows, lost))

    def flush(self, now: bool = False) -> bool:
        """Write the queued rows if `FLUSH_S` has passed since the last write.

        Args:
            now: Whether to write even if that time has not passed.

        Returns:
            True if the queue was written and is now empty.

        Raises:
            OSError: The disk is full.
        """
        if not now and time.monotonic() < self._flush_at:
            return False
        self._flush_at = time.monotonic() + FLUSH_S
        if self._waiting:
            counts = [(ring, len(rows), lost) for ring, rows, lost in self._waiting]
            data = b"".join(rows.tobytes() for _, rows, _ in self._waiting)
            packed = b64encode(pa.compress(data, codec="zstd", asbytes=True)).decode()
            self._waiting = []
            _write_part(self._out, Frame(counts, packed))
        return True

    def close(self, end: int = OPEN_END) -> None:
        """Close the spool, so that another recorder can continue it.

        Args:
            end: Tick at which the current stretch of a flight recorder ends. Unknown by default.
        """
        self._finish_stretch(end)
        self._file.close()


def _write_part(file: IO[bytes], part: SpoolHead | Part) -> None:
    """Write a part as a line to an unbuffered file. Raises `OSError` if the disk is full."""
    line = format_checked_line({type(part).__name__: part}).encode()
    while line:
        # An unbuffered file may write only part of the data at once.
        line = line[file.write(line) :]


def _read_parts(file: IO[bytes], path: Path) -> Iterator[Any]:
    """Yield the parts of a spool or stretch, up to the last complete line.

    Raises:
        Failure: A line is damaged.
    """
    while line := file.readline().decode(errors="replace"):
        is_whole = line.endswith("\n")
        if not is_whole and is_cut_off(line):
            return
        try:
            ((kind, fields),) = parse_checked_line(line).items()
        except ValueError as error:
            where = f"damaged, or of an earlier version, before byte {file.tell()}"
            raise Failure(f"{path}: {where}: {error}", 2) from None
        if is_whole:
            yield PART_TYPES[kind](*fields)


def read_head(file: IO[bytes], path: Path) -> tuple[Layout, Launch]:
    """Read the head of a spool, and leave the file positioned after it.

    Returns:
        Layout and launch of the rack.

    Raises:
        Failure: The head is incomplete or damaged.
    """
    file.seek(0)
    head = next(_read_parts(file, path), None)
    if head is None:
        raise Failure(f"{path}: it ends before its first row", 2)
    return restore_layout(head.layout), Launch(*head.launch)


def read_spool(file: IO[bytes], folder: Path) -> Iterator[Part]:
    """Yield the parts after the head of a spool, then the parts of all its stretches."""
    yield from _read_parts(file, folder / SPOOL)
    yield from _read_stretches(list_stretch_files(folder))


def _read_stretches(paths: Iterable[Path]) -> Iterator[Part]:
    """Yield the parts in these files of stretches, file by file."""
    for path in paths:
        check_file(path)
        with path.open("rb") as file:
            yield from _read_parts(file, path)


def list_stretch_files(folder: Path) -> list[Path]:
    """List the files of the stretches in a folder, oldest first."""
    return sorted((folder / STRETCHES).glob("*.spool"))


def open_rings(segment: Segment) -> dict[str, Ring]:
    """Open every ring of a rack, keyed by task or mailbox. The tasks come first."""
    traces = {task.name: open_trace_ring(segment, task.name) for task in segment.layout.tasks}
    return traces | {
        mailbox.name: MailboxRing(segment, mailbox.name) for mailbox in segment.layout.timed
    }


def list_ring_dtypes(layout: Layout) -> dict[str, np.dtype]:
    """Return a dictionary from task or mailbox to the row type of its ring."""
    traces = {task.name: RECORD for task in layout.tasks}
    return traces | {mailbox.name: build_row_dtype(mailbox) for mailbox in layout.timed}


def try_lock(file: IO[bytes]) -> bool:
    """Try to lock a file. Returns False if another process has locked it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

"""The files of a recording, and the spool that makes them safe: a parquet file is readable only
once its footer, written last, is there.

Every ring's rows also go to `recorder.spool` as they are, compressed, one frame a ring about ten
times a second. A restarted recorder continues from the spool; `mend` makes the parquet files from
the spool of a recorder that is gone. The spool is removed when the files are complete. A truncated
last frame is dropped. The rings hold two seconds, so a recorder that is back within that time loses
nothing.

A flight recorder (`[record] keep`) writes no parquet files: frames go to stretches, files that are
removed again unless something happened near them. The head of each says what was taken before it,
so the tables can be made from any of them. They are made when the run is opened: ten minutes of the
NASREM rack take half a minute.
"""

from __future__ import annotations

import fcntl
import json
import os
import struct
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, NamedTuple, Self

import numpy as np
import pyarrow as pa

from rack.backplane.layout import Layout
from rack.backplane.mailbox.history import MailboxRing, row_dtype
from rack.backplane.ring import Ring
from rack.backplane.segment import Launch, Segment, layout_of
from rack.backplane.trace import RECORD, trace_ring
from rack.tools.console.answer import Failure
from rack.tools.recording.recorder_process import SPOOL

MAGIC = b"RACKSPL2"
FLUSH_S = 0.1
"""SIGKILL of all processes loses what boards wrote in this time, between two drains, and in one or
two passes of the recorder, which last longer on a busy machine."""
_HEAD = struct.Struct("<8sII")
"""Magic, size and CRC of the layout and launch that follow as JSON."""
_FRAME = struct.Struct("<IIIII")
"""Ring, rows, rows lost before them, size and CRC of the data that follow."""
STRETCHES = "stretches"
_STRETCH = struct.Struct("<8sqII")
"""Magic, the tick at which it ended, size and CRC of the rest of its head, which follows as
JSON."""
_ENDED = struct.Struct("<q")
OPEN = -1
"""End of a stretch that is being written, or whose recorder was killed."""


class Frame(NamedTuple):
    """Rows of one ring, and how many rows were lost before them."""

    ring: str
    rows: np.ndarray
    lost: int


class Packed(NamedTuple):
    """A frame as it is in a file: `data` are the rows, compressed."""

    ring: str
    dtype: np.dtype
    rows: int
    lost: int
    data: bytes

    def unpacked(self) -> Frame:
        """Return it with its rows."""
        size = self.rows * self.dtype.itemsize
        data = pa.decompress(self.data, size, "zstd", asbytes=True)
        return Frame(self.ring, np.frombuffer(data, self.dtype), self.lost)


class StretchHead(NamedTuple):
    """The head of a stretch: its number from 1, and what its recorder had taken before it.

    It holds what ended from tick `begin` to before `end`. By ring, `taken` is the number of the
    last record before it, and `rows` counts the rows.
    """

    number: int
    begin: int
    taken: dict[str, int]
    rows: dict[str, int]
    end: int = OPEN

    def create(self, folder: Path) -> IO[bytes]:
        """Create its file, to be written; the kernel has at once whatever is written."""
        folder.mkdir(exist_ok=True)
        text = json.dumps(self[:-1]).encode()
        file = self.path(folder).open("wb", buffering=0)
        _write(file, _STRETCH.pack(MAGIC, self.end, len(text), zlib.crc32(text)) + text)
        return file

    def path(self, folder: Path) -> Path:
        """Return its file in the folder of stretches."""
        return folder / f"{self.number:08}.spool"

    @classmethod
    def read(cls, file: IO[bytes]) -> Self | None:
        """Read it; None if its recorder was killed as it began."""
        head = file.read(_STRETCH.size)
        if len(head) < _STRETCH.size or not head.startswith(MAGIC):
            return None
        _, end, size, crc = _STRETCH.unpack(head)
        text = file.read(size)
        if zlib.crc32(text) != crc:
            return None
        number, begin, taken, rows = json.loads(text)
        return cls(number, begin, taken, rows, end)


class Spool:
    """The spool of a folder, open for writing; continues one that another recorder left, after
    `resume`.

    Raises `Failure` when another recorder has it open, or it belongs to another rack.
    """

    def __init__(self, folder: Path, layout: Layout, launch: Launch) -> None:
        self.path = folder / SPOOL
        # Readable as well, and unbuffered: the kernel has at once whatever is written.
        self._file = self.path.open("a+b", buffering=0)
        self._out: IO[bytes] = self._file
        self._folder = folder
        self._layout = layout
        self._rings = {name: place for place, name in enumerate(_dtypes(layout))}
        self._waiting: dict[str, list[np.ndarray]] = {name: [] for name in self._rings}
        self._lost = dict.fromkeys(self._rings, 0)
        self._flush_at = 0.0
        try:
            if not locked(self._file):
                raise Failure(f"{self.path}: another recorder is running there")
            if not self.path.stat().st_size:
                text = json.dumps({"layout": asdict(layout), "launch": launch}).encode()
                _write(self._file, _HEAD.pack(MAGIC, len(text), zlib.crc32(text)) + text)
            if (found := read_head(self._file, self.path)) != (layout, launch):
                raise Failure(
                    f"{self.path}: holds a recording of another launch or rack, '{found[0].rack}'"
                )
        except BaseException:
            self.close()
            raise

    def resume(self) -> Iterator[StretchHead | Packed]:
        """Yield what another recorder left, and continue after it."""
        whole = self._file.tell()
        for packed in _read_frames(self._file, self._layout):
            yield packed
            whole = self._file.tell()
        self._file.truncate(whole)
        # What was taken before a stretch is in its head. That of the newest one may be cut off.
        yield from read(self._file, self._folder, self._layout, newest=2)

    def divert(self, stretch: StretchHead, end: int) -> Path:
        """Finish the stretch that is being written, which ends at a tick, and write what is added
        from now on into another; return its file."""
        self.flush(now=True)
        self._seal(end)
        self._out = stretch.create(self._folder / STRETCHES)
        return stretch.path(self._folder / STRETCHES)

    def _seal(self, end: int) -> None:
        if self._out is not self._file:
            os.pwrite(self._out.fileno(), _ENDED.pack(end), len(MAGIC))
            self._out.close()

    def add(self, ring: str, rows: np.ndarray, lost: int) -> None:
        """Add rows from a ring."""
        if lost and self._waiting[ring]:
            # A frame's lost rows are those before its first.
            self.flush(now=True)
        if len(rows):
            self._waiting[ring].append(rows)
        self._lost[ring] += lost

    def flush(self, now: bool = False) -> bool:
        """Write what waits, when it is due or `now`; return whether it did. Raises `OSError` when
        the disk is full."""
        if not now and time.monotonic() < self._flush_at:
            return False
        self._flush_at = time.monotonic() + FLUSH_S
        _write(self._out, b"".join(self._packed()))
        return True

    def _packed(self) -> Iterator[bytes]:
        for ring, place in self._rings.items():
            blocks = self._waiting[ring]
            lost = self._lost[ring]
            if blocks or lost:
                rows = sum(map(len, blocks))
                packed = pa.compress(
                    b"".join(block.tobytes() for block in blocks), codec="zstd", asbytes=True
                )
                yield _FRAME.pack(place, rows, lost, len(packed), zlib.crc32(packed)) + packed
                self._waiting[ring] = []
                self._lost[ring] = 0

    def remove(self) -> None:
        """Remove the spool: the parquet files are complete."""
        self.path.unlink()
        self.close()

    def close(self, end: int = OPEN) -> None:
        """Close the spool and leave it to another recorder; its stretch, if any, ends at a tick."""
        self._seal(end)
        self._file.close()


def _write(file: IO[bytes], data: bytes) -> None:
    """Write all of it to an unbuffered file, which may take a part at a time. Raises `OSError` when
    the disk is full."""
    while data:
        data = data[file.write(data) :]


def read_head(file: IO[bytes], path: Path) -> tuple[Layout, Launch]:
    """Return what the head of a spool says of the rack; its frames follow. Raises `Failure`."""
    file.seek(0)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or not head.startswith(MAGIC):
        raise Failure(f"{path}: not a recorder's spool", 2)
    _, size, crc = _HEAD.unpack(head)
    text = file.read(size)
    if len(text) < size or zlib.crc32(text) != crc:
        raise Failure(f"{path}: truncated before its first row", 2)
    head = json.loads(text)
    return layout_of(head["layout"]), Launch(*head["launch"])


def read(
    file: IO[bytes], folder: Path, layout: Layout, newest: int | None = None
) -> Iterator[StretchHead | Packed]:
    """Yield the frames of a spool, which is open after its head, then its stretches with theirs, or
    the `newest` ones."""
    yield from _read_frames(file, layout)
    paths = stretch_files(folder)
    for path in paths if newest is None else paths[-newest:]:
        with path.open("rb") as part:
            if (stretch := StretchHead.read(part)) is not None:
                yield stretch
                yield from _read_frames(part, layout)


def stretch_files(folder: Path) -> list[Path]:
    """Return the files of the stretches in a folder, oldest first."""
    return sorted((folder / STRETCHES).glob("*.spool"))


def _read_frames(file: IO[bytes], layout: Layout) -> Iterator[Packed]:
    rings = list(_dtypes(layout).items())
    while len(head := file.read(_FRAME.size)) == _FRAME.size:
        place, count, lost, size, crc = _FRAME.unpack(head)
        data = file.read(size)
        if len(data) < size or zlib.crc32(data) != crc or place >= len(rings):
            return
        name, dtype = rings[place]
        yield Packed(name, dtype, count, lost, data)


def rings(segment: Segment) -> dict[str, Ring]:
    """Return every ring of a rack: traces by task, then messages by mailbox."""
    traces = {task.name: trace_ring(segment, task.name) for task in segment.layout.tasks}
    return traces | {
        mailbox.name: MailboxRing(segment, mailbox.name) for mailbox in segment.layout.timed
    }


def _dtypes(layout: Layout) -> dict[str, np.dtype]:
    """Return the row type of every ring of a rack: traces by task, then messages by mailbox."""
    traces = {task.name: RECORD for task in layout.tasks}
    return traces | {mailbox.name: row_dtype(mailbox) for mailbox in layout.timed}


def locked(file: IO[bytes]) -> bool:
    """Lock a file; return False if another process has locked it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

"""What a recorder has taken, on disk at once: parquet files can be read only when their footer is written, at the end.

Every ring's rows go to `recorder.spool` as they are, compressed, a frame a ring about four times a second. Whoever
finds a spool without a recorder makes the parquet files from it; a restarted recorder goes on with it. It is removed
when the files are whole. A last frame that was cut off is dropped; rings hold two seconds, so a recorder that comes
back sooner has lost nothing.
"""

from __future__ import annotations

import fcntl
import json
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
import pyarrow as pa

from rack.backplane.layout import Layout
from rack.backplane.mailbox.history import row_dtype
from rack.backplane.segment import layout_of
from rack.backplane.trace import RECORD
from rack.tools.answer import Failure

NAME = "recorder.spool"
MAGIC = b"RACKSPL1"
FLUSH_S = 0.25
_HEAD = struct.Struct("<8sII")
"""Magic, size and CRC of the layout that follows as JSON."""
_FRAME = struct.Struct("<IIIII")
"""Ring, rows, rows lost before them, size of what follows, and its CRC."""


class Frame(NamedTuple):
    """Rows of one ring, and how many before them were lost."""

    ring: str
    rows: np.ndarray
    lost: int


class Spool:
    """The spool of a folder, open for writing; one that another recorder has left is continued, after `resume`.

    Raises `Failure` when another recorder has it open, or it is another rack's.
    """

    def __init__(self, folder: Path, layout: Layout) -> None:
        self.path = folder / NAME
        # Readable too, and without a buffer: what is written is the kernel's at once.
        self._file = self.path.open("a+b", buffering=0)
        self._layout = layout
        self._rings = {name: place for place, name in enumerate(_dtypes(layout))}
        self._waiting: dict[str, list[np.ndarray]] = {name: [] for name in self._rings}
        self._lost = dict.fromkeys(self._rings, 0)
        self._flush_at = 0.0
        try:
            _lock(self._file, self.path)
            if not self.path.stat().st_size:
                text = json.dumps(asdict(layout)).encode()
                self._file.write(_HEAD.pack(MAGIC, len(text), zlib.crc32(text)) + text)
            self._file.seek(0)
            if (found := _layout(self._file, self.path)) != layout:
                raise Failure(f"{self.path}: holds a recording of another rack, '{found.rack}'")
        except BaseException:
            self.close()
            raise

    def resume(self, take: Callable[[Frame], None]) -> None:
        """Hand over what another recorder has left here, and go on behind it."""
        whole = self._file.tell()
        for frame in _frames(self._file, self._layout):
            take(frame)
            whole = self._file.tell()
        self._file.truncate(whole)

    def add(self, ring: str, rows: np.ndarray, lost: int) -> None:
        """Take what came from a ring."""
        if len(rows):
            self._waiting[ring].append(rows)
        self._lost[ring] += lost

    def flush(self, now: bool = False) -> None:
        """Hand to the kernel what waits, `now` or when it is time. Raises `OSError` when the disk is full."""
        if not now and time.monotonic() < self._flush_at:
            return
        self._flush_at = time.monotonic() + FLUSH_S
        waiting = b"".join(self._packed())
        while waiting:
            waiting = waiting[self._file.write(waiting) :]

    def _packed(self) -> Iterator[bytes]:
        for ring, place in self._rings.items():
            blocks, lost = self._waiting[ring], self._lost[ring]
            if blocks or lost:
                rows = sum(map(len, blocks))
                packed = pa.compress(b"".join(block.tobytes() for block in blocks), codec="zstd", asbytes=True)
                yield _FRAME.pack(place, rows, lost, len(packed), zlib.crc32(packed)) + packed
                self._waiting[ring], self._lost[ring] = [], 0

    def remove(self) -> None:
        """Remove it: the files are whole."""
        self.path.unlink()
        self.close()

    def close(self) -> None:
        """Leave it to others."""
        self._file.close()


def read(folder: Path, take: Callable[[Layout], Callable[[Frame], None]]) -> None:
    """Hand over what a recorder that is gone has left: its layout first, then frame by frame.

    Raises `Failure` when it is not gone, or nothing can be read.
    """
    path = folder / NAME
    with path.open("rb") as file:
        _lock(file, path)
        layout = _layout(file, path)
        take_frame = take(layout)
        for frame in _frames(file, layout):
            take_frame(frame)


def _layout(file: IO[bytes], path: Path) -> Layout:
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or not head.startswith(MAGIC):
        raise Failure(f"{path}: not a recorder's spool", 2)
    _, size, crc = _HEAD.unpack(head)
    text = file.read(size)
    if len(text) < size or zlib.crc32(text) != crc:
        raise Failure(f"{path}: cut off before its first row", 2)
    return layout_of(json.loads(text))


def _frames(file: IO[bytes], layout: Layout) -> Iterator[Frame]:
    rings = list(_dtypes(layout).items())
    while len(head := file.read(_FRAME.size)) == _FRAME.size:
        place, count, lost, size, crc = _FRAME.unpack(head)
        packed = file.read(size)
        if len(packed) < size or zlib.crc32(packed) != crc or place >= len(rings):
            return
        name, dtype = rings[place]
        yield Frame(
            name, np.frombuffer(pa.decompress(packed, count * dtype.itemsize, "zstd", asbytes=True), dtype), lost
        )


def _dtypes(layout: Layout) -> dict[str, np.dtype]:
    """Return every ring of a rack with its rows' type: traces by task, then messages by mailbox."""
    traces = {task.name: RECORD for task in layout.tasks}
    return traces | {mailbox.name: row_dtype(mailbox) for mailbox in layout.mailboxes}


def _lock(file: IO[bytes], path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise Failure(f"{path}: a recorder is still at work there") from None

"""The files of a recording, and the spool that makes them safe: a parquet file is readable only
once its footer, written last, is there.

Every ring's rows also go to `recorder.spool` as they are, compressed, one frame a ring about ten
times a second. A restarted recorder continues from the spool; `mend` makes the parquet files from
the spool of a recorder that is gone. The spool is removed when the files are complete. A truncated
last frame is dropped; any other damage is an error. The rings hold two seconds, so a recorder that
is back within that time loses nothing.

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
from typing import IO, Any, NamedTuple, Self

import numpy as np
import pyarrow as pa

from rack.backplane.json_text import encode_json
from rack.backplane.layout import Layout
from rack.backplane.mailbox.history import MailboxRing, row_dtype
from rack.backplane.ring import Ring
from rack.backplane.segment import Launch, Segment, layout_of
from rack.backplane.trace import RECORD, trace_ring
from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import Checksums, check_file
from rack.tools.recording.parquet import CONFIG
from rack.tools.recording.recorder_process import ORIGIN, SPOOL

MAGIC = b"RACKSPL3"
"""First bytes of a spool and of a stretch. A CRC follows every other part of them."""
FLUSH_S = 0.1
"""SIGKILL of all processes loses what boards wrote in this time, between two drains, and in one or
two passes of the recorder, which last longer on a busy machine."""
_SIZE_BYTES = 4
"""Bytes of the size of the JSON that follows it: layout and launch in a spool, the head of a
stretch."""
_FRAME = struct.Struct("<IIII")
"""Ring, rows, rows lost before them, size of the data that follow."""
STRETCHES = "stretches"
_ENDED = struct.Struct("<q")
"""Tick at which a stretch ended. It follows the magic."""
_CRC_BYTES = 4
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
        file = self.path(folder).open("wb", buffering=0)
        _write(file, MAGIC + _seal(_ENDED.pack(self.end)) + _pack(self[:-1]))
        return file

    def path(self, folder: Path) -> Path:
        """Return its file in the folder of stretches."""
        return folder / f"{self.number:08}.spool"

    @classmethod
    def read(cls, file: IO[bytes], path: Path) -> Self | None:
        """Read it; None if its recorder was killed as it began. Raises `Failure` if it is
        damaged."""
        _read_magic(file, path)
        ended = _unseal(file, _ENDED.size, path)
        head = _unpack(file, path)
        return None if ended is None or head is None else cls(*head, *_ENDED.unpack(ended))


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
                # The config and the origin of the run are written before its recorder begins.
                Checksums(folder).store(CONFIG, ORIGIN)
                _write(self._file, MAGIC + _pack({"layout": asdict(layout), "launch": launch}))
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
        for packed in _read_frames(self._file, self._layout, self.path):
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
            os.pwrite(self._out.fileno(), _seal(_ENDED.pack(end)), len(MAGIC))
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
                yield _seal(_FRAME.pack(place, rows, lost, len(packed))) + _seal(packed)
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


def _seal(data: bytes) -> bytes:
    """Return data with their CRC."""
    return data + zlib.crc32(data).to_bytes(_CRC_BYTES)


def _unseal(file: IO[bytes], size: int, path: Path) -> bytes | None:
    """Read data with their CRC.

    Args:
        file: File to read from.
        size: Size of the data.
        path: Path of the file.

    Returns:
        The data. None if the file ends before them.

    Raises:
        Failure: The data are damaged.
    """
    found = file.read(size + _CRC_BYTES)
    if len(found) < size + _CRC_BYTES:
        return None
    data = found[:size]
    if _seal(data) != found:
        raise Failure(f"{path}: damaged: the checksum before byte {file.tell()} is wrong", 2)
    return data


def _pack(document: Any) -> bytes:
    text = encode_json(document).encode()
    return _seal(len(text).to_bytes(_SIZE_BYTES)) + _seal(text)


def _unpack(file: IO[bytes], path: Path) -> Any:
    """Return a document that `_pack` packed; None if the file ends before it."""
    size = _unseal(file, _SIZE_BYTES, path)
    text = size and _unseal(file, int.from_bytes(size), path)
    return text and json.loads(text)


def _read_magic(file: IO[bytes], path: Path) -> None:
    if not MAGIC.startswith(file.read(len(MAGIC))):
        raise Failure(f"{path}: not a recorder's spool, or one of an earlier version", 2)


def read_head(file: IO[bytes], path: Path) -> tuple[Layout, Launch]:
    """Return what the head of a spool says of the rack; its frames follow. Raises `Failure`."""
    file.seek(0)
    _read_magic(file, path)
    head = _unpack(file, path)
    if head is None:
        raise Failure(f"{path}: truncated before its first row", 2)
    return layout_of(head["layout"]), Launch(*head["launch"])


def read(
    file: IO[bytes], folder: Path, layout: Layout, newest: int | None = None
) -> Iterator[StretchHead | Packed]:
    """Yield the frames of a spool, which is open after its head, then its stretches with theirs, or
    the `newest` ones."""
    yield from _read_frames(file, layout, folder / SPOOL)
    paths = stretch_files(folder)
    for path in paths if newest is None else paths[-newest:]:
        check_file(path)
        with path.open("rb") as part:
            if (stretch := StretchHead.read(part, path)) is not None:
                yield stretch
                yield from _read_frames(part, layout, path)


def stretch_files(folder: Path) -> list[Path]:
    """Return the files of the stretches in a folder, oldest first."""
    return sorted((folder / STRETCHES).glob("*.spool"))


def _read_frames(file: IO[bytes], layout: Layout, path: Path) -> Iterator[Packed]:
    rings = list(_dtypes(layout).items())
    while head := _unseal(file, _FRAME.size, path):
        place, count, lost, size = _FRAME.unpack(head)
        if (data := _unseal(file, size, path)) is None:
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

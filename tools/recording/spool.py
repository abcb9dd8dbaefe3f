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
import struct
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any, NamedTuple

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
from rack.tools.recording.recorder_process import CODE, ORIGIN, SPOOL

MAGIC = b"RACKSPL4"
"""First bytes of a spool."""
FLUSH_S = 0.1
"""SIGKILL of all processes loses what boards wrote in this time, between two drains, and in one or
two passes of the recorder, which last longer on a busy machine."""
_SIZES = struct.Struct("<II")
"""Head of a part of a spool or stretch: sizes of the JSON document and of the data that follow."""
_CRC_BYTES = 4
STRETCHES = "stretches"
OPEN = -1
"""End of a stretch that is being written, or whose recorder was killed."""


class Frame(NamedTuple):
    """How many rows of a ring were taken, and lost before them; `data` are the rows, compressed."""

    ring: str
    dtype: np.dtype
    length: int
    lost: int
    data: bytes

    def unpack(self) -> np.ndarray:
        """Return the rows."""
        size = self.length * self.dtype.itemsize
        return np.frombuffer(pa.decompress(self.data, size, "zstd", asbytes=True), self.dtype)


class StretchHead(NamedTuple):
    """The head of a stretch: its number from 1, and what its recorder had taken before it.

    It holds what ended from tick `begin` on. By ring, `taken` is the number of the last record
    before it, and `rows` counts the rows.
    """

    number: int
    begin: int
    taken: dict[str, int]
    rows: dict[str, int]


class StretchEnd(NamedTuple):
    """The last part of a stretch, which holds what ended before this tick; a recorder that was
    killed leaves none."""

    tick: int


Part = StretchHead | Frame | StretchEnd


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
        self._lost = dict.fromkeys(_dtypes(layout), 0)
        self._waiting: dict[str, list[np.ndarray]] = {name: [] for name in self._lost}
        self._flush_at = 0.0
        try:
            if not locked(self._file):
                raise Failure(f"{self.path}: another recorder is running there")
            if not self.path.stat().st_size:
                # The config and the origin of the run are written before its recorder begins.
                Checksums(folder).store(CONFIG, ORIGIN, CODE)
                _write(self._file, MAGIC + _pack({"layout": asdict(layout), "launch": launch}))
            if (found := read_head(self._file, self.path)) != (layout, launch):
                raise Failure(
                    f"{self.path}: holds a recording of another launch or rack, '{found[0].rack}'"
                )
        except BaseException:
            self.close()
            raise

    def resume(self) -> Iterator[Part]:
        """Yield what another recorder left, and continue after it."""
        whole = self._file.tell()
        for frame in _read_frames(self._file, self._layout, self.path):
            yield frame
            whole = self._file.tell()
        self._file.truncate(whole)
        # What was taken before a stretch is in its head. That of the newest one may be cut off.
        yield from read(self._file, self._folder, self._layout, newest=2)

    def divert(self, stretch: StretchHead, end: int) -> Path:
        """Finish the stretch that is being written, which ends at a tick, and write what is added
        from now on into another; return its file."""
        self.flush(now=True)
        self._finish_stretch(end)
        path = self._folder / STRETCHES / f"{stretch.number:08}.spool"
        path.parent.mkdir(exist_ok=True)
        self._out = path.open("wb", buffering=0)
        _write(self._out, _pack(stretch))
        return path

    def _finish_stretch(self, end: int) -> None:
        if self._out is not self._file:
            if end != OPEN:
                _write(self._out, _pack(StretchEnd(end)))
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
        for ring, blocks in self._waiting.items():
            if blocks or self._lost[ring]:
                data = b"".join(block.tobytes() for block in blocks)
                frame = (ring, sum(map(len, blocks)), self._lost[ring])
                yield _pack(frame, pa.compress(data, codec="zstd", asbytes=True))
                self._waiting[ring] = []
                self._lost[ring] = 0

    def remove(self) -> None:
        """Remove the spool: the parquet files are complete."""
        self.path.unlink()
        self.close()

    def close(self, end: int = OPEN) -> None:
        """Close the spool and leave it to another recorder; its stretch, if any, ends at a tick."""
        self._finish_stretch(end)
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


def _pack(document: Any, data: bytes = b"") -> bytes:
    text = encode_json(document).encode()
    return _seal(_SIZES.pack(len(text), len(data))) + _seal(text + data)


def _unpack(file: IO[bytes], path: Path) -> tuple[Any, bytes] | None:
    """Return a document and data that `_pack` packed; None if the file ends before them."""
    if (sizes := _unseal(file, _SIZES.size, path)) is None:
        return None
    text_size, data_size = _SIZES.unpack(sizes)
    body = _unseal(file, text_size + data_size, path)
    return None if body is None else (json.loads(body[:text_size]), body[text_size:])


def read_head(file: IO[bytes], path: Path) -> tuple[Layout, Launch]:
    """Return what the head of a spool says of the rack; its frames follow. Raises `Failure`."""
    file.seek(0)
    if not MAGIC.startswith(file.read(len(MAGIC))):
        raise Failure(f"{path}: not a recorder's spool, or one of an earlier version", 2)
    if (head := _unpack(file, path)) is None:
        raise Failure(f"{path}: truncated before its first row", 2)
    return layout_of(head[0]["layout"]), Launch(*head[0]["launch"])


def read(
    file: IO[bytes], folder: Path, layout: Layout, newest: int | None = None
) -> Iterator[Part]:
    """Yield the frames of a spool, which is open after its head, then its stretches with theirs, or
    the `newest` ones."""
    yield from _read_frames(file, layout, folder / SPOOL)
    paths = stretch_files(folder)
    for path in paths if newest is None else paths[-newest:]:
        check_file(path)
        with path.open("rb") as part:
            # Its recorder may have been killed as it began.
            if (head := _unpack(part, path)) is not None:
                yield StretchHead(*head[0])
                yield from _read_frames(part, layout, path)


def stretch_files(folder: Path) -> list[Path]:
    """Return the files of the stretches in a folder, oldest first."""
    return sorted((folder / STRETCHES).glob("*.spool"))


def _read_frames(file: IO[bytes], layout: Layout, path: Path) -> Iterator[Frame | StretchEnd]:
    dtypes = _dtypes(layout)
    while (part := _unpack(file, path)) is not None:
        document, data = part
        if len(document) == len(StretchEnd._fields):
            yield StretchEnd(*document)
        else:
            ring, length, lost = document
            yield Frame(ring, dtypes[ring], length, lost, data)


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

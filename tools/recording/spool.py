"""The files of a recording, and the spool that makes them safe: a parquet file is readable only
once its footer, written last, is there.

Every ring's rows also go to `recorder.spool` as they are, compressed, one frame a ring about four
times a second. A restarted recorder continues from the spool; `mend` makes the parquet files from
the spool of a recorder that is gone. The spool is removed when the files are complete. A truncated
last frame is dropped. The rings hold two seconds, so a recorder that is back within that time loses
nothing.
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
from shutil import copyfile, rmtree
from typing import IO, NamedTuple

import numpy as np
import pyarrow as pa

from rack.backplane.layout import Layout
from rack.backplane.mailbox.history import MailboxRing, row_dtype
from rack.backplane.ring import Ring
from rack.backplane.segment import Launch, Segment, layout_of
from rack.backplane.trace import RECORD, trace_ring
from rack.tools.console.answer import Failure
from rack.tools.recording.cores import UNMEASURED, CoreRecord
from rack.tools.recording.parquet import CONFIG, SIGNALS, CyclesFile, SignalTables
from rack.tools.recording.recorder_process import SPOOL

CYCLES = "cycles.parquet"
EVENTS = "events.jsonl"
MENDED = "-mended"
MAGIC = b"RACKSPL2"
FLUSH_S = 0.25
_HEAD = struct.Struct("<8sII")
"""Magic, size and CRC of the layout and launch that follow as JSON."""
_FRAME = struct.Struct("<IIIII")
"""Ring, rows, rows lost before them, size and CRC of the data that follow."""


class Frame(NamedTuple):
    """Rows of one ring, and how many rows were lost before them."""

    ring: str
    rows: np.ndarray
    lost: int


class RunFiles:
    """cycles.parquet and signals/ of a folder, being written.

    By ring, `lost` counts the rows lost, and `taken` is the number of its last record so far.
    `gaps` holds where they were lost: ring, first and last tick without rows.
    """

    def __init__(self, folder: Path, layout: Layout, launch: Launch, suffix: str = "") -> None:
        self.tasks = [task.name for task in layout.tasks]
        self.lost = dict.fromkeys([*self.tasks, *(mailbox.name for mailbox in layout.timed)], 0)
        self.taken = dict(self.lost)
        self.gaps: list[tuple[str, int, int]] = []
        self._reached = dict.fromkeys(self.lost, (-1, 0))
        """Of each ring the newest tick, and the rows lost by then."""
        self._cycles = CyclesFile(folder / f"{CYCLES}{suffix}", layout, launch)
        self._signals = SignalTables(folder / f"{SIGNALS}{suffix}", layout)

    def add(self, frame: Frame) -> None:
        """Add rows of a ring."""
        name, rows, lost = frame
        self.lost[name] += lost
        self.taken[name] += lost + len(rows)
        if len(rows):
            tick, before = self._reached[name]
            if self.lost[name] > before:
                self.gaps.append((name, tick + 1, int(rows["tick"][0]) - 1))
            self._reached[name] = int(rows["tick"][-1]), self.lost[name]
        if name in self.tasks:
            self._cycles.add(name, rows)
        elif len(rows):
            self._signals.add(name, rows)
            # Messages that every reader rejects were left out.
            self.taken[name] = int(rows["serial"][-1])

    def close(self, cores: CoreRecord = UNMEASURED) -> None:
        """Finish all files; the trace keeps what the machine did to its cores."""
        self._signals.close()
        self._cycles.close(self.lost, cores, self.gaps)


def mend(folder: Path) -> bool:
    """Make the files from the spool of a killed recorder; return False where there is none.

    Raises `Failure` when that recorder is still running, or its spool cannot be read.
    """
    path = folder / SPOOL
    if not path.is_file():
        return False
    with path.open("rb") as file:
        _lock(file, path)
        layout, launch = _read_head(file, path)
        files = RunFiles(folder, layout, launch, MENDED)
        for frame in _read_frames(file, layout):
            files.add(frame)
    files.close()
    rmtree(folder / SIGNALS, ignore_errors=True)
    for name in (CYCLES, SIGNALS):
        (folder / f"{name}{MENDED}").replace(folder / name)
    path.unlink()
    return True


def save(folder: Path, into: Path) -> None:
    """Make a run's folder, `into`, of what the recorder of `folder` has taken so far; that one goes
    on."""
    into.mkdir(parents=True, exist_ok=True)
    for name in (CONFIG, EVENTS, SPOOL):
        if (folder / name).is_file():
            copyfile(folder / name, into / name)
    mend(into)


class Spool:
    """The spool of a folder, open for writing; continues one that another recorder left, after
    `resume`.

    Raises `Failure` when another recorder has it open, or it belongs to another rack.
    """

    def __init__(self, folder: Path, layout: Layout, launch: Launch) -> None:
        self.path = folder / SPOOL
        # Readable as well, and unbuffered: the kernel has at once whatever is written.
        self._file = self.path.open("a+b", buffering=0)
        self._layout = layout
        self._rings = {name: place for place, name in enumerate(_dtypes(layout))}
        self._waiting: dict[str, list[np.ndarray]] = {name: [] for name in self._rings}
        self._lost = dict.fromkeys(self._rings, 0)
        self._flush_at = 0.0
        try:
            _lock(self._file, self.path)
            if not self.path.stat().st_size:
                text = json.dumps({"layout": asdict(layout), "launch": launch}).encode()
                self._file.write(_HEAD.pack(MAGIC, len(text), zlib.crc32(text)) + text)
            self._file.seek(0)
            if (found := _read_head(self._file, self.path)) != (layout, launch):
                raise Failure(
                    f"{self.path}: holds a recording of another launch or rack, '{found[0].rack}'"
                )
        except BaseException:
            self.close()
            raise

    def resume(self, take: Callable[[Frame], None]) -> None:
        """Hand over the frames that another recorder left, and continue after them."""
        whole = self._file.tell()
        for frame in _read_frames(self._file, self._layout):
            take(frame)
            whole = self._file.tell()
        self._file.truncate(whole)

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
        waiting = b"".join(self._packed())
        while waiting:
            waiting = waiting[self._file.write(waiting) :]
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

    def close(self) -> None:
        """Close the spool and leave it to another recorder."""
        self._file.close()


def _read_head(file: IO[bytes], path: Path) -> tuple[Layout, Launch]:
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or not head.startswith(MAGIC):
        raise Failure(f"{path}: not a recorder's spool", 2)
    _, size, crc = _HEAD.unpack(head)
    text = file.read(size)
    if len(text) < size or zlib.crc32(text) != crc:
        raise Failure(f"{path}: truncated before its first row", 2)
    head = json.loads(text)
    return layout_of(head["layout"]), Launch(*head["launch"])


def _read_frames(file: IO[bytes], layout: Layout) -> Iterator[Frame]:
    rings = list(_dtypes(layout).items())
    while len(head := file.read(_FRAME.size)) == _FRAME.size:
        place, count, lost, size, crc = _FRAME.unpack(head)
        packed = file.read(size)
        if len(packed) < size or zlib.crc32(packed) != crc or place >= len(rings):
            return
        name, dtype = rings[place]
        data = pa.decompress(packed, count * dtype.itemsize, "zstd", asbytes=True)
        yield Frame(name, np.frombuffer(data, dtype), lost)


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


def _lock(file: IO[bytes], path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise Failure(f"{path}: another recorder is running there") from None

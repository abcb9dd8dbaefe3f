"""What a recorder leaves in the folder of a run: cycles.parquet and signals/, made as rows come, or
later from its spool.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path
from shutil import rmtree
from typing import IO, NamedTuple

import numpy as np

from rack.backplane.errors import SegmentError
from rack.backplane.layout import Layout
from rack.backplane.segment import Launch, Segment
from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.cores import UNMEASURED, CoreRecord
from rack.tools.recording.file_names import SPOOL
from rack.tools.recording.parquet import SIGNALS, CyclesFile, signal_tables
from rack.tools.recording.spool import (
    OPEN,
    STRETCHES,
    Frame,
    Part,
    StretchEnd,
    StretchHead,
    locked,
    read,
    read_head,
    ring_dtypes,
    rings,
)

CYCLES = "cycles.parquet"
TABLES = (CYCLES, f"{SIGNALS}/*/*")
"""Patterns of the files that hold rows."""
EVENTS = "events.jsonl"
MENDED = "-mended"
POLL_S = 0.2
"""Time between two attempts to lock the spool of a recorder that finishes."""
FINISH_S = 20.0
"""Longest wait for a recorder that finishes without its launcher."""


class Missing(NamedTuple):
    """Rows of a ring that a recording lacks, of how many that were written."""

    rows: int
    written: int


def find_missing(
    segment: Segment, taken: Mapping[str, int], lost: Mapping[str, int]
) -> dict[str, Missing]:
    """Return what a recording lacks of the rings of a rack that has ended.

    Args:
        segment: The rack.
        taken: Number of the last record that was taken, by ring.
        lost: Number of rows before it that are not in the recording, by ring.

    Returns:
        The rows missing, by task and by mailbox.
    """
    found = {}
    for name, ring in rings(segment).items():
        ring.resume(taken[name])
        written = taken[name] - ring.before + ring.waiting
        left, overwritten = ring.drain()
        if rows := lost[name] + overwritten + len(left):
            found[name] = Missing(rows, written)
    return found


class Tally:
    """What a recorder has taken of a rack's rings, or left of it on disk.

    By ring, `lost` counts the rows lost, `rows` those taken, and `taken` is the number of its last
    record so far, from `before` on. `kept` holds the ticks of the stretches that a flight recorder
    kept, [first, end).
    """

    def __init__(self, layout: Layout, before: Mapping[str, int] | None = None) -> None:
        self.tasks = [task.name for task in layout.tasks]
        self._dtypes = ring_dtypes(layout)
        self.lost = dict.fromkeys(self._dtypes, 0)
        self.taken = {**self.lost, **(before or {})}
        self.rows = dict(self.lost)
        self.kept: list[tuple[int, int]] = []
        self.number = 0
        self._newest = -1

    def take(self, part: Part) -> None:
        """Take what is in a spool."""
        match part:
            case StretchHead():
                self.begin(part)
            case StretchEnd():
                self.end(part.tick)
            case Frame():
                for block in part.unpack(self._dtypes):
                    self.add(*block)

    def begin(self, stretch: StretchHead) -> None:
        """Go on with a stretch; others before it may have been removed."""
        follows = stretch.number == self.number + 1
        if follows:
            # Rows are missing only if the file before is damaged.
            for name, rows in stretch.rows.items():
                self.lost[name] += rows - self.rows[name]
        self.taken.update(stretch.taken)
        self.rows.update(stretch.rows)
        if follows and self.kept:
            self.kept[-1] = self.kept[-1][0], OPEN
        else:
            self.end()
            self.kept.append((stretch.begin, OPEN))
        self.number = stretch.number

    def add(self, name: str, rows: np.ndarray, lost: int) -> None:
        """Add rows of a ring, and count those lost before them."""
        self.count(name, len(rows), lost)
        if len(rows):
            self._newest = int(rows["tick"][-1])
            if name not in self.tasks:
                # Messages that every reader rejects were left out.
                self.taken[name] = int(rows["serial"][-1])

    def count(self, name: str, rows: int, lost: int) -> None:
        """Count rows of a ring, and those lost before them."""
        self.lost[name] += lost
        self.rows[name] += rows
        self.taken[name] += lost + rows

    def end(self, tick: int = OPEN) -> None:
        """End the last stretch at a tick, or else where its recorder was killed."""
        if self.kept and self.kept[-1][1] == OPEN:
            first = self.kept[-1][0]
            self.kept[-1] = first, max(first, self._newest + 1) if tick == OPEN else tick


class RunFiles(Tally):
    """cycles.parquet and signals/ of a folder, being written.

    `gaps` holds where rows were lost: ring, first and last tick without rows.
    """

    def __init__(
        self,
        folder: Path,
        layout: Layout,
        launch: Launch,
        suffix: str = "",
        before: Mapping[str, int] | None = None,
    ) -> None:
        super().__init__(layout, before)
        self.gaps: list[tuple[str, int, int]] = []
        self._reached = dict.fromkeys(self.lost, (-1, 0))
        """Of each ring the newest tick, and the rows lost by then."""
        self._cycles = CyclesFile(folder / f"{CYCLES}{suffix}", layout, launch)
        self._signals = signal_tables(folder / f"{SIGNALS}{suffix}", layout)

    def begin(self, stretch: StretchHead) -> None:
        """Go on with a stretch: what is not there before it was removed, not lost."""
        if stretch.number != self.number + 1:
            self._reached = {name: (stretch.begin - 1, lost) for name, lost in self.lost.items()}
        super().begin(stretch)

    def add(self, name: str, rows: np.ndarray, lost: int) -> None:
        """Add rows of a ring, and count those lost before them."""
        super().add(name, rows, lost)
        if len(rows):
            tick, before = self._reached[name]
            if self.lost[name] > before:
                self.gaps.append((name, tick + 1, int(rows["tick"][0]) - 1))
            self._reached[name] = int(rows["tick"][-1]), self.lost[name]
        if name in self.tasks:
            self._cycles.add(name, rows)
        elif len(rows):
            self._signals[name].add(rows)

    def close(self, cores: CoreRecord = UNMEASURED) -> None:
        """Finish all files; the trace keeps what the machine did to its cores."""
        self.end()
        for table in self._signals.values():
            table.close()
        self._cycles.close(self.lost, cores, self.gaps, self.kept)


def mend(folder: Path) -> bool:
    """Make the files from the spool that a killed recorder left, or a flight recorder; return False
    where there is none.

    Raises `Failure` when that recorder is still running, or its spool cannot be read.
    """
    path = folder / SPOOL
    if not path.is_file():
        return False
    with path.open("rb") as file:
        _lock(file, path)
        if not path.is_file():
            # The recorder has finished its files meanwhile.
            return False
        layout, launch = read_head(file, path)
        files = RunFiles(folder, layout, launch, MENDED)
        for part in read(file, folder):
            files.take(part)
        # Still locked: another process that opens this run waits until the files are in place.
        files.close()
        rmtree(folder / SIGNALS, ignore_errors=True)
        for name in (CYCLES, SIGNALS):
            (folder / f"{name}{MENDED}").replace(folder / name)
        Checksums(folder).store(*TABLES)
        # First: without it what is left of the stretches is not taken for a run.
        path.unlink()
        rmtree(folder / STRETCHES, ignore_errors=True)
    return True


def tally(folder: Path) -> Tally | None:
    """Return what a flight recorder has left in a folder, by the counts of its frames;
    None where none has. Raises `Failure` when it cannot be read.
    """
    path = folder / SPOOL
    if not path.is_file() or not (folder / STRETCHES).is_dir():
        return None
    with path.open("rb") as file:
        layout, _ = read_head(file, path)
        found = Tally(layout)
        for part in read(file, folder):
            if isinstance(part, Frame):
                for counts in part.counts:
                    found.count(*counts)
            else:
                found.take(part)
    found.end()
    return found


def _lock(file: IO[bytes], path: Path) -> None:
    """Lock a spool; where its launcher was killed, wait for its recorder to finish."""
    deadline = time.monotonic() + FINISH_S
    while not locked(file):
        if _is_running(*read_head(file, path)):
            raise Failure(f"{path}: another recorder is running there")
        if time.monotonic() > deadline:
            raise Failure(f"{path}: its recorder has not finished within {FINISH_S:g} s")
        time.sleep(POLL_S)


def _is_running(layout: Layout, launch: Launch) -> bool:
    with suppress(SegmentError), closing(Segment.attach(layout.rack)) as segment:
        return segment.launch == launch and not segment.run_is_over
    return False

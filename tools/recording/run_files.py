"""Writes the rows of a run, live or from a spool, to cycles.parquet and signals/."""

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
from rack.tools.recording.parquet import SIGNALS, CyclesFile, create_signal_tables
from rack.tools.recording.spool import (
    OPEN_END,
    STRETCHES,
    Frame,
    Part,
    StretchEnd,
    StretchHead,
    list_ring_dtypes,
    open_rings,
    read_head,
    read_spool,
    try_lock,
)

CYCLES = "cycles.parquet"
TABLE_PATTERNS = (CYCLES, f"{SIGNALS}/*/*")
"""Patterns of the files that contain rows."""
EVENTS = "events.jsonl"
REBUILT_SUFFIX = "-mended"
POLL_S = 0.2
"""Time between two attempts to lock the spool of a recorder that is finishing."""
FINISH_S = 20.0
"""Longest time to wait for a recorder that finishes after its launcher has ended."""


class MissingRows(NamedTuple):
    """Number of rows of a ring that are missing from a recording.

    Attributes:
        rows: The number of missing rows.
        written: Number of rows that were written to the ring.
    """

    rows: int
    written: int


def find_missing(
    segment: Segment, taken: Mapping[str, int], lost: Mapping[str, int]
) -> dict[str, MissingRows]:
    """Count the rows of a rack's rings that are missing from its recording.

    Call this only when the rack has ended.

    Args:
        segment: Segment of the rack.
        taken: Number of the last record that the recorder read from each ring.
        lost: Number of earlier records of each ring that are not in the recording.

    Returns:
        Dictionary from task or mailbox to its missing rows. Complete rings are left out.
    """
    missing = {}
    for name, ring in open_rings(segment).items():
        ring.taken = taken[name]
        written = taken[name] - ring.before + ring.waiting_count
        left, overwritten = ring.read_new_rows()
        if rows := lost[name] + overwritten + len(left):
            missing[name] = MissingRows(rows, written)
    return missing


class Tally:
    """Counts of the rows that a recorder has read from a rack's rings.

    A ring is named by its task or mailbox. A spool, in which a recorder stores the rows, consists
    of parts. A flight recorder divides the spool into stretches and deletes some of them.

    Attributes:
        tasks: Names of the tasks, whose rings are traces.
        lost: Number of rows of each ring that were overwritten before they were read.
        taken: Number of the last record read from each ring. Initially the constructor's `before`,
            or 0.
        rows: Number of rows read from each ring.
        kept: Ranges of ticks [first, end) that were not deleted. Consecutive stretches are one
            range.
        stretch_number: Number of the newest stretch.
    """

    def __init__(self, layout: Layout, before: Mapping[str, int] | None = None) -> None:
        self.tasks = [task.name for task in layout.tasks]
        self._dtypes = list_ring_dtypes(layout)
        self.lost = dict.fromkeys(self._dtypes, 0)
        self.taken = {**self.lost, **(before or {})}
        self.rows = dict(self.lost)
        self.kept: list[tuple[int, int]] = []
        self.stretch_number = 0
        self._newest = -1

    def count_part(self, part: Part) -> None:
        """Update the counts with one part of a spool: rows, or the head or end of a stretch."""
        match part:
            case StretchHead():
                self.begin_stretch(part)
            case StretchEnd():
                self.end_stretch(part.tick)
            case Frame():
                for block in part.unpack_rows(self._dtypes):
                    self.add_rows(*block)

    def begin_stretch(self, stretch: StretchHead) -> None:
        """Begin a stretch, and set the counts to those in its head.

        If no stretch was deleted before it, rows that are missing before it count as lost.
        """
        follows = stretch.number == self.stretch_number + 1
        if follows:
            # Rows are missing here only if the file of the previous stretch is damaged.
            for name, rows in stretch.rows.items():
                self.lost[name] += rows - self.rows[name]
        self.taken.update(stretch.taken)
        self.rows.update(stretch.rows)
        if follows and self.kept:
            self.kept[-1] = self.kept[-1][0], OPEN_END
        else:
            self.end_stretch()
            self.kept.append((stretch.begin, OPEN_END))
        self.stretch_number = stretch.number

    def add_rows(self, name: str, rows: np.ndarray, lost: int) -> None:
        """Add rows of a ring to the counts.

        Args:
            name: Name of the ring.
            rows: The rows, shape (rows,).
            lost: Number of rows lost before these rows.
        """
        self.lost[name] += lost
        self.rows[name] += len(rows)
        self.taken[name] += lost + len(rows)
        if len(rows):
            self._newest = int(rows["tick"][-1])
            if name not in self.tasks:
                # The recorder skips damaged messages, so the serial may exceed the count of rows.
                self.taken[name] = int(rows["serial"][-1])

    def end_stretch(self, tick: int = OPEN_END) -> None:
        """End the last stretch.

        Args:
            tick: Tick at which it ends. By default, the tick after its newest row, because a
                killed recorder writes no end.
        """
        if self.kept and self.kept[-1][1] == OPEN_END:
            first = self.kept[-1][0]
            self.kept[-1] = first, max(first, self._newest + 1) if tick == OPEN_END else tick


class RunFiles(Tally):
    """Writer of cycles.parquet and signals/ in the folder of a run.

    Attributes:
        gaps: Ring, first and last tick of each range of ticks in which rows were lost.
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
        """Newest tick of each ring, and the number of rows lost up to that tick."""
        self._cycles = CyclesFile(folder / f"{CYCLES}{suffix}", layout, launch)
        self._signals = create_signal_tables(folder / f"{SIGNALS}{suffix}", layout)

    def begin_stretch(self, stretch: StretchHead) -> None:
        """Begin a stretch. Deleted stretches before it are not recorded as a gap."""
        if stretch.number != self.stretch_number + 1:
            self._reached = {name: (stretch.begin - 1, lost) for name, lost in self.lost.items()}
        super().begin_stretch(stretch)

    def add_rows(self, name: str, rows: np.ndarray, lost: int) -> None:
        """Write rows of a ring. Adds a gap if rows were lost before these rows.

        Args:
            name: Name of the ring.
            rows: The rows, shape (rows,).
            lost: Number of rows lost before these rows.
        """
        super().add_rows(name, rows, lost)
        if len(rows):
            tick, before = self._reached[name]
            if self.lost[name] > before:
                self.gaps.append((name, tick + 1, int(rows["tick"][0]) - 1))
            self._reached[name] = int(rows["tick"][-1]), self.lost[name]
        if name in self.tasks:
            self._cycles.add_records(name, rows)
        elif len(rows):
            self._signals[name].add_rows(rows)

    def close(self, cores: CoreRecord = UNMEASURED) -> None:
        """Finish all files. Stolen time and frequency of the cores are stored with the trace."""
        self.end_stretch()
        for table in self._signals.values():
            table.close()
        self._cycles.close(self.lost, cores, self.gaps, self.kept)


def rebuild_files(folder: Path) -> bool:
    """Build the files of a run from the spool of a killed recorder or of a flight recorder.

    Returns:
        True if the files were built, False if the folder contains no spool.

    Raises:
        Failure: The recorder is still running, or its spool cannot be read.
    """
    path = folder / SPOOL
    if not path.is_file():
        return False
    with path.open("rb") as file:
        _lock_spool(file, path)
        if not path.is_file():
            # The recorder finished its files while this process waited for the lock.
            return False
        layout, launch = read_head(file, path)
        files = RunFiles(folder, layout, launch, REBUILT_SUFFIX)
        for part in read_spool(file, folder):
            files.count_part(part)
        # Keep the spool locked, so that another process that opens this run waits for the files.
        files.close()
        rmtree(folder / SIGNALS, ignore_errors=True)
        for name in (CYCLES, SIGNALS):
            (folder / f"{name}{REBUILT_SUFFIX}").replace(folder / name)
        Checksums(folder).store(*TABLE_PATTERNS)
        # Remove the spool before the stretches. If this process is killed in between, the leftover
        # stretches are ignored.
        path.unlink()
        rmtree(folder / STRETCHES, ignore_errors=True)
    return True


def count_spool(folder: Path) -> Tally | None:
    """Count the rows in a flight recorder's spool.

    Returns:
        The counts, or None if the folder contains no spool of a flight recorder.

    Raises:
        Failure: The spool cannot be read.
    """
    path = folder / SPOOL
    if not path.is_file() or not (folder / STRETCHES).is_dir():
        return None
    with path.open("rb") as file:
        layout, _ = read_head(file, path)
        counted = Tally(layout)
        for part in read_spool(file, folder):
            counted.count_part(part)
    counted.end_stretch()
    return counted


def _lock_spool(file: IO[bytes], path: Path) -> None:
    """Lock a spool, so that no recorder and no other reader can use it.

    Waits up to `FINISH_S` for a recorder that is finishing after its launcher has ended.

    Raises:
        Failure: A recorder still records the run, or does not finish in time.
    """
    deadline = time.monotonic() + FINISH_S
    while not try_lock(file):
        if _is_running(*read_head(file, path)):
            raise Failure(f"{path}: another recorder is still writing it")
        if time.monotonic() > deadline:
            raise Failure(f"{path}: its recorder did not finish within {FINISH_S:g} s")
        time.sleep(POLL_S)


def _is_running(layout: Layout, launch: Launch) -> bool:
    """Return True if the rack of this launch is still running."""
    with suppress(SegmentError), closing(Segment.attach(layout.rack)) as segment:
        return segment.launch == launch and not segment.run_is_over
    return False

"""Streams a recording for the viewer into a file, to a viewer on this machine, or both.

The rows of the recording have times on three timelines: simulated time, tick and wall clock. They
are written in blocks, each with rows of one mailbox or task.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, SupportsIndex

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from rack.backplane.segment import Launch
from rack.tools.recording.time_line import RackAlignment

Ints = NDArray[np.int64]

SIM_TIME = "sim_time"
TICK = "tick"
WALL = "wall"
REMEMBERED_TICKS = 4096
"""Number of stored pairs of tick and time stamp.

The times of ticks without a time stamp are interpolated from them.
"""
APPLICATION = "rack"
LOG = "log"
FLUSH_S = 0.5
"""Longest time that a flush waits for the disk.

The recorder does not read the rings in that time, and they hold only two seconds.
"""
SERVER_MEMORY = "200MB"
"""Amount of recorded data that the server keeps for viewers that connect later."""


class Moment(NamedTuple):
    """A point in time: a tick, and a time stamp of CLOCK_MONOTONIC."""

    tick: int
    stamp_ns: int


class Timelines:
    """Converts ticks and CLOCK_MONOTONIC stamps to times on the timelines of the recording.

    The timelines are simulated time, tick and wall clock. If `placed` is given, times are converted
    to the timelines of another rack. All times are integers, in ns.
    """

    def __init__(self, clock_ns: int, launch: Launch, placed: RackAlignment | None = None) -> None:
        self.clock_ns = clock_ns
        self._offset_ns = launch.wall_offset_ns
        self._placed = placed
        self._ticks: Ints = np.zeros(1, dtype=np.int64)
        self._stamps: Ints = np.array([launch.monotonic_ns])

    def compute_times(
        self, ticks: Ints, stamps_ns: Ints, within_ns: Ints | int = 0
    ) -> tuple[Ints, Ints, Ints]:
        """Return the times of rows on the three timelines: simulated time, tick and wall clock.

        Args:
            ticks: Release ticks, shape (rows,).
            stamps_ns: Time stamps of CLOCK_MONOTONIC, shape (rows,).
            within_ns: Simulated time to add to each release.
        """
        if (placed := self._placed) is None:
            return ticks * self.clock_ns + within_ns, ticks, stamps_ns + self._offset_ns
        return (
            placed.convert_ticks(ticks, within_ns),
            placed.convert_ticks(ticks, 0) // placed.reference_grid.clock_ns,
            placed.convert_to_wall_clock(stamps_ns),
        )

    def build_columns(
        self, ticks: Ints, stamps_ns: Ints, within_ns: Ints | int = 0
    ) -> list[rr.TimeColumn]:
        """Return the times of rows as one time column for each timeline; see `compute_times`."""
        simulated_ns, ticks, wall_ns = self.compute_times(ticks, stamps_ns, within_ns)
        return [
            rr.TimeColumn(SIM_TIME, duration=simulated_ns.astype("timedelta64[ns]")),
            rr.TimeColumn(TICK, sequence=ticks),
            rr.TimeColumn(WALL, timestamp=wall_ns.astype("datetime64[ns]")),
        ]

    def add_stamps(self, ticks: Ints, stamps_ns: Ints) -> None:
        """Store time stamps of ticks, from which the times of other ticks are estimated.

        Args:
            ticks: The ticks in ascending order, shape (n,).
            stamps_ns: Their time stamps of CLOCK_MONOTONIC, shape (n,).
        """
        new = ticks > self._ticks[-1]
        self._ticks = np.concatenate((self._ticks, ticks[new]))[-REMEMBERED_TICKS:]
        self._stamps = np.concatenate((self._stamps, stamps_ns[new]))[-REMEMBERED_TICKS:]

    def estimate_stamps(self, ticks: Ints) -> Ints:
        """Return the approximate times of ticks on CLOCK_MONOTONIC, in ns."""
        # Interpolate differences from the newest stamp. A float cannot represent a whole time
        # stamp in ns exactly.
        last = self._stamps[-1]
        return np.asarray(
            last + np.interp(ticks, self._ticks, self._stamps - last).astype(np.int64)
        )

    def estimate_moment(self, tick: int) -> Moment:
        """Return a tick together with its approximate time."""
        return Moment(tick, int(self.estimate_stamps(np.array([tick]))[0]))

    def to_monotonic(self, time_ns: int) -> int:
        """Convert a time stamp of CLOCK_REALTIME to CLOCK_MONOTONIC, both in ns."""
        return time_ns - self._offset_ns


class RowBlock:
    """Rows of one task or mailbox, oldest first, with their times.

    The rows of a task are trace records with the fields of `rack.backplane.trace.RECORD`. The rows
    of a mailbox have the fields of `rack.backplane.mailbox.history.MailboxRing`.

    Attributes:
        rows: The rows, shape (rows,).
        ticks: Release ticks, shape (rows,).
        stamps_ns: Time stamps of CLOCK_MONOTONIC, shape (rows,).
        resumed: True for each row before which the writer was silent, shape (rows,).
    """

    def __init__(
        self, rows: np.ndarray, timelines: Timelines, resumed: np.ndarray | None = None
    ) -> None:
        stamp = "stamp_ns" if "stamp_ns" in (rows.dtype.names or ()) else "start_ns"
        self.rows = rows  # (rows,)
        self.ticks: Ints = rows["tick"].astype(np.int64)  # (rows,)
        self.stamps_ns: Ints = rows[stamp].astype(np.int64)  # (rows,), CLOCK_MONOTONIC
        self.resumed = np.zeros(len(rows), bool) if resumed is None else resumed  # (rows,)
        self._timelines = timelines

    @cached_property
    def time_columns(self) -> list[rr.TimeColumn]:
        """Time columns of all rows, which are built once for all view parts."""
        return self._timelines.build_columns(self.ticks, self.stamps_ns)

    def build_time_columns(self, rows: Ints | list[int]) -> list[rr.TimeColumn]:
        """Return the time columns of the rows with these indices."""
        return self._timelines.build_columns(self.ticks[rows], self.stamps_ns[rows])

    def find_moment(self, row: SupportsIndex) -> Moment:
        """Return the release tick and the time stamp of a row."""
        return Moment(int(self.ticks[row]), int(self.stamps_ns[row]))

    def find_visible_moment(self, row: SupportsIndex) -> Moment:
        """Return the tick at which a message becomes visible, with the time stamp of its row."""
        return Moment(int(self.rows["visible_at"][row]), int(self.stamps_ns[row]))

    @property
    def messages(self) -> np.ndarray:
        """The messages in the rows of a mailbox, shape (rows,)."""
        return np.asarray(self.rows["message"])


ViewPart = Callable[[RowBlock], None]
"""A function that writes one aspect of a mailbox or task to the stream, block by block."""


def build_change_finder() -> Callable[[np.ndarray], Ints]:
    """Return a function that finds the rows in which a value changes.

    Call the function with the values of one block after the other, shape (rows,). It returns the
    indices of the rows that differ from the previous row, which may be in the previous block. The
    first row of the first block counts as a change.
    """
    last: np.ndarray | None = None

    def changed_rows(values: np.ndarray) -> Ints:
        """Return the indices of rows that differ from the previous row, even across blocks."""
        nonlocal last
        changed = values != np.concatenate((values[:1] if last is None else last, values[:-1]))
        changed[0] |= last is None
        last = values[-1:].copy()
        return np.flatnonzero(changed)

    return changed_rows


def open_recording(
    name: str, run: str, file: Path | None, blueprint: rrb.Blueprint, port: int | None = None
) -> rr.RecordingStream:
    """Open a recording that is written into a file, served on a port of this machine, or both.

    Args:
        name: Name of the recording in the viewer.
        run: Id of the run. Files with the same id are shown as one recording.
        file: File to write, or None.
        blueprint: The initial view.
        port: Port on which the recording is served, or None.
    """
    # Without strict mode, rerun only prints a warning about a wrong call and leaves out its data.
    rr.set_strict_mode(True)
    recording = rr.RecordingStream(APPLICATION, recording_id=run)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    sinks: list[rr.FileSink | rr.GrpcServerSink] = []
    if file is not None:
        sinks.append(rr.FileSink(str(file)))
    if port is not None:
        # Use a server, not a client: a client whose viewer is not running would also block writing
        # to the file.
        sinks.append(rr.GrpcServerSink("127.0.0.1", port, server_memory_limit=SERVER_MEMORY))
    recording.set_sinks(*sinks, default_blueprint=blueprint)
    recording.send_recording_name(name)
    return recording


class Stream:
    """Writes the data of one rack to a recording.

    An entity is given as the parts of its path. A part may contain any character. All entities of
    the rack are below the path `root`.
    """

    def __init__(
        self, recording: rr.RecordingStream, times: Timelines, root: Sequence[str] = ()
    ) -> None:
        self._recording = recording
        self.times = times
        self._root = root

    def format_frame(self, name: str) -> str:
        """Return the full name of a coordinate frame of the rack.

        Frames are global in a recording, so the name begins with the root.
        """
        return "/".join((*self._root, name))

    def build_frame(self, frame: str) -> rr.CoordinateFrame:
        """Return the component that attaches an entity to a coordinate frame of the rack."""
        return rr.CoordinateFrame(self.format_frame(frame))

    def _build_path(self, entity: Sequence[str]) -> str:
        """Return the full path of an entity, including the root."""
        return build_path(*self._root, *entity)

    def log_static(self, entity: Sequence[str], *archetypes: rr.AsComponents) -> None:
        """Write data of an entity that apply at all times."""
        self._recording.log(self._build_path(entity), *archetypes, static=True)

    def send_columns(
        self, entity: Sequence[str], times: list[rr.TimeColumn], columns: rr.ComponentColumnList
    ) -> None:
        """Write a block of rows of an entity.

        Args:
            entity: The entity.
            times: Time columns of the rows.
            columns: Component columns of the rows.
        """
        self._recording.send_columns(self._build_path(entity), times, columns)

    def send_curves(
        self, entity: Sequence[str], times: list[rr.TimeColumn], values: np.ndarray
    ) -> None:
        """Write a block of values of an entity that are shown as curves.

        Args:
            entity: The entity.
            times: Time columns of the rows.
            values: Values of one curve, shape (rows,), or of several, shape (rows, curves).
        """
        self.send_columns(entity, times, rr.Scalars.columns(scalars=values))

    def log_at(self, when: Moment, entity: Sequence[str], archetype: rr.AsComponents) -> None:
        """Write data of an entity for a single moment.

        Args:
            when: The moment.
            entity: The entity.
            archetype: The data.
        """
        moment = np.array([when.tick]), np.array([when.stamp_ns])
        simulated_ns, tick, wall_ns = (int(times[0]) for times in self.times.compute_times(*moment))
        self._recording.set_time(SIM_TIME, duration=np.timedelta64(simulated_ns, "ns"))
        self._recording.set_time(TICK, sequence=tick)
        self._recording.set_time(WALL, timestamp=np.datetime64(wall_ns, "ns"))
        self._recording.log(self._build_path(entity), archetype)

    def log_line(self, when: Moment, source: str, text: str, level: str) -> None:
        """Write a line and its tick to the log, after the rack's name if there are several racks.

        Args:
            when: Time of the line.
            source: Name of the entity below the log that gets the line.
            text: The line.
            level: Log level of rerun, for example "WARN".
        """
        line = rr.TextLog(": ".join((*self._root, f"tick {when.tick}", text)), level=level)
        self.log_at(when, (LOG, source), line)

    def log_property(self, name: str, values: rr.AsComponents) -> None:
        """Write values as a property of the whole recording."""
        self._recording.send_property(" ".join((*self._root, name)), values)

    def flush(self) -> None:
        """Write all pending data to the file. Raises `RuntimeError` if they cannot be written."""
        self._recording.flush(timeout_sec=FLUSH_S)

    def continue_in(self, file: Path) -> None:
        """Finish the current file, and write all further data to another file of the same run."""
        self._recording.set_sinks(rr.FileSink(str(file)))

    def close(self) -> None:
        """Finish the file."""
        self._recording.disconnect()


def build_path(*parts: str) -> str:
    """Return the path of an entity, given its parts."""
    return rr.new_entity_path(list(parts))

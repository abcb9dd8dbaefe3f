"""The recording for the viewer, as a stream: to a file always, and to a viewer on this machine if
one is wanted.

Its rows have three timelines: simulated time, tick, wall clock. They come in blocks, of one mailbox
or one task.
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
from rack.tools.recording.time_line import RackPlace

Ints = NDArray[np.int64]

SIM_TIME = "sim_time"
TICK = "tick"
WALL = "wall"
KEPT = 4096
"""Pairs of tick and time kept, to place what has a tick but no time stamp."""
APPLICATION = "rack"
LOG = "log"
FLUSH_S = 0.5
"""Longest single wait for the disk: the rings, not drained meanwhile, hold two seconds."""
SERVER_MEMORY = "200MB"
"""What the server keeps for a viewer that joins later."""


class Moment(NamedTuple):
    """When something happened: a tick, and a stamp of CLOCK_MONOTONIC."""

    tick: int
    stamp_ns: int


class RowTimes(NamedTuple):
    """Times of rows, each (rows,): simulated, ns; tick; wall clock, ns."""

    simulated_ns: Ints
    ticks: Ints
    wall_ns: Ints


class Timelines:
    """Converts ticks and CLOCK_MONOTONIC stamps to time columns; all integers, ns.

    Of a rack `placed` on the time line of another one, all three are that one's.
    """

    def __init__(self, clock_ns: int, launch: Launch, placed: RackPlace | None = None) -> None:
        self.clock_ns = clock_ns
        self._offset_ns = launch.wall_offset_ns
        self._placed = placed
        self._ticks: Ints = np.zeros(1, dtype=np.int64)
        self._stamps: Ints = np.array([launch.monotonic_ns])

    def times(self, ticks: Ints, stamps_ns: Ints, within_ns: Ints | int = 0) -> RowTimes:
        """Return the times of rows released at `ticks`, `within_ns` of simulated time later,
        stamped `stamps_ns`.
        """
        if (placed := self._placed) is None:
            return RowTimes(ticks * self.clock_ns + within_ns, ticks, stamps_ns + self._offset_ns)
        released = placed.times_ns(ticks, 0) // placed.line.clock_ns
        return RowTimes(placed.times_ns(ticks, within_ns), released, placed.wall_ns(stamps_ns))

    def columns(
        self, ticks: Ints, stamps_ns: Ints, within_ns: Ints | int = 0
    ) -> list[rr.TimeColumn]:
        """Return the same times as columns."""
        found = self.times(ticks, stamps_ns, within_ns)
        return [
            rr.TimeColumn(SIM_TIME, duration=found.simulated_ns.astype("timedelta64[ns]")),
            rr.TimeColumn(TICK, sequence=found.ticks),
            rr.TimeColumn(WALL, timestamp=found.wall_ns.astype("datetime64[ns]")),
        ]

    def learn(self, ticks: Ints, stamps_ns: Ints) -> None:
        """Remember when ticks happened; both are sorted."""
        new = ticks > self._ticks[-1]
        self._ticks = np.concatenate((self._ticks, ticks[new]))[-KEPT:]
        self._stamps = np.concatenate((self._stamps, stamps_ns[new]))[-KEPT:]

    def stamps_of(self, ticks: Ints) -> Ints:
        """Return approximately when ticks happened, CLOCK_MONOTONIC, ns."""
        # Relative to the newest, so that the 53 bits of a float suffice.
        last = self._stamps[-1]
        return np.asarray(
            last + np.interp(ticks, self._ticks, self._stamps - last).astype(np.int64)
        )

    def moment_of(self, tick: int) -> Moment:
        """Return approximately when a tick happened."""
        return Moment(tick, int(self.stamps_of(np.array([tick]))[0]))

    def monotonic(self, time_ns: int) -> int:
        """Return a CLOCK_REALTIME stamp as CLOCK_MONOTONIC."""
        return time_ns - self._offset_ns


class RowBlock:
    """Rows of one ring, oldest first, with their times.

    Rows of a mailbox have the fields of `rack.backplane.mailbox.history.MailboxRing`, those of a
    trace the fields of `rack.backplane.trace.RECORD`.
    """

    def __init__(self, rows: np.ndarray, timelines: Timelines) -> None:
        stamp = "stamp_ns" if "stamp_ns" in (rows.dtype.names or ()) else "start_ns"
        self.rows = rows  # (rows,)
        self.ticks: Ints = rows["tick"].astype(np.int64)  # (rows,)
        self.stamps_ns: Ints = rows[stamp].astype(np.int64)  # (rows,), CLOCK_MONOTONIC
        self._timelines = timelines

    @cached_property
    def times(self) -> list[rr.TimeColumn]:
        """The time columns of all rows, made once for all parts that write them."""
        return self._timelines.columns(self.ticks, self.stamps_ns)

    def times_of(self, rows: Ints | list[int]) -> list[rr.TimeColumn]:
        """Return the time columns of some rows, by their indices."""
        return self._timelines.columns(self.ticks[rows], self.stamps_ns[rows])

    def when(self, row: SupportsIndex) -> Moment:
        """Return when a row was written."""
        return Moment(int(self.ticks[row]), int(self.stamps_ns[row]))

    def visible(self, row: SupportsIndex) -> Moment:
        """Return the same for a mailbox's row, at the tick at which it is visible."""
        return Moment(int(self.rows["visible_at"][row]), int(self.stamps_ns[row]))

    @property
    def messages(self) -> np.ndarray:
        """The messages of a mailbox's rows."""
        return np.asarray(self.rows["message"])


ViewPart = Callable[[RowBlock], None]
"""Writes one aspect of one mailbox or task to the stream, block by block."""


def change_finder() -> Callable[[np.ndarray], Ints]:
    """Return a function that takes the values of consecutive blocks, (rows,) or structured, and
    returns the indices of the rows that differ from the row before.
    """
    last: np.ndarray | None = None

    def changed_rows(values: np.ndarray) -> Ints:
        nonlocal last
        changed = values != np.concatenate((values[:1] if last is None else last, values[:-1]))
        changed[0] |= last is None
        last = values[-1:].copy()
        return np.flatnonzero(changed)

    return changed_rows


SHOWN_S = 0.02
"""Time between things drawn: the rate of a screen."""


def row_sampler(clock_ns: int) -> Callable[[Ints], Ints]:
    """Return a function that takes the ticks of consecutive blocks, and returns the indices of the
    rows that are drawn: the first of every 20 ms of simulated time.
    """
    every = max(1, round(SHOWN_S * 1e9 / clock_ns))
    last = -1

    def sampled_rows(ticks: Ints) -> Ints:
        nonlocal last
        slots, first = np.unique(ticks // every, return_index=True)
        chosen = first[slots > last]
        last = int(slots[-1])
        return np.asarray(chosen)

    return sampled_rows


def new_recording(
    name: str, run: str, file: Path | None, blueprint: rrb.Blueprint, port: int | None = None
) -> rr.RecordingStream:
    """Return a recording to be written into a file, and served on a port of this machine, as far as
    they are given.

    Files of one `run` are shown as one recording.
    """
    # Otherwise a mistake is a warning on stderr and a gap in the recording.
    rr.set_strict_mode(True)
    recording = rr.RecordingStream(APPLICATION, recording_id=run)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    sinks: list[rr.FileSink | rr.GrpcServerSink] = []
    if file is not None:
        sinks.append(rr.FileSink(str(file)))
    if port is not None:
        # A server, not a client: a client without its viewer would block the file as well.
        sinks.append(rr.GrpcServerSink("127.0.0.1", port, server_memory_limit=SERVER_MEMORY))
    recording.set_sinks(*sinks, default_blueprint=blueprint)
    recording.send_recording_name(name)
    return recording


class Stream:
    """What one rack adds to a recording. Entities are named by parts, which may hold any character.

    All of them are below `root`. `flush` raises `RuntimeError` once the file cannot be written.
    """

    def __init__(
        self, recording: rr.RecordingStream, times: Timelines, root: Sequence[str] = ()
    ) -> None:
        self._recording = recording
        self.times = times
        self._root = root

    def frame(self, name: str) -> str:
        """Return the name of a coordinate frame: frames are known to all entities of a
        recording.
        """
        return "/".join((*self._root, name))

    def within(self, frame: str) -> rr.CoordinateFrame:
        """Return what puts an entity into a frame."""
        return rr.CoordinateFrame(self.frame(frame))

    def _path(self, entity: Sequence[str]) -> str:
        return path(*self._root, *entity)

    def static(self, entity: Sequence[str], *archetypes: rr.AsComponents) -> None:
        """Log what holds at all times."""
        self._recording.log(self._path(entity), *archetypes, static=True)

    def columns(
        self, entity: Sequence[str], times: list[rr.TimeColumn], columns: rr.ComponentColumnList
    ) -> None:
        """Send a block of rows."""
        self._recording.send_columns(self._path(entity), times, columns)

    def scalars(
        self, entity: Sequence[str], times: list[rr.TimeColumn], values: np.ndarray
    ) -> None:
        """Send a block of curves, shape (rows,) or (rows, curves)."""
        self.columns(entity, times, rr.Scalars.columns(scalars=values))

    def at(self, when: Moment, entity: Sequence[str], archetype: rr.AsComponents) -> None:
        """Log a single item."""
        found = self.times.times(np.array([when.tick]), np.array([when.stamp_ns]))
        self._recording.set_time(
            SIM_TIME, duration=np.timedelta64(int(found.simulated_ns[0]), "ns")
        )
        self._recording.set_time(TICK, sequence=int(found.ticks[0]))
        self._recording.set_time(WALL, timestamp=np.datetime64(int(found.wall_ns[0]), "ns"))
        self._recording.log(self._path(entity), archetype)

    def say(self, when: Moment, source: str, text: str, level: str) -> None:
        """Write a line to the log, under its source; of a rack among several it begins with the
        rack's name.
        """
        line = rr.TextLog(": ".join((*self._root, text)), level=level)
        self.at(when, (LOG, source), line)

    def property(self, name: str, values: rr.AsComponents) -> None:
        """Log a property of the run."""
        self._recording.send_property(" ".join((*self._root, name)), values)

    def flush(self) -> None:
        """Write everything to the file. Raises `RuntimeError` when that fails."""
        self._recording.flush(timeout_sec=FLUSH_S)

    def continue_in(self, file: Path) -> None:
        """Finish the file and go on in another, which is of the same run."""
        self._recording.set_sinks(rr.FileSink(str(file)))

    def close(self) -> None:
        """Finish the file."""
        self._recording.disconnect()


def path(*parts: str) -> str:
    """Return the path of an entity from its parts."""
    return rr.new_entity_path(list(parts))

"""Log lines: the rack's events, from its event log, and the recorder's own losses and load.

Each board also has a lane: the kind of its last event, until the next.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import rerun as rr

from rack.boards.events import Event
from rack.tools.recording.checksums import read_line
from rack.tools.viewer.cell import Marks
from rack.tools.viewer.levels import Hierarchy
from rack.tools.viewer.stream import Moment, Stream
from rack.tools.viewer.style import EVENT_COLOURS, LOST, style_curves, style_lane, write_span

EVENTS = "events"
RECORDER = "recorder"
UNSHOWN = ("printed", "miss")
"""Events without a lane: misses have their own."""
RACK = "rack"
"""Lane of events that belong to no board."""
LEVELS = {
    "died": "ERROR",
    "detection": "ERROR",
    "fault": "WARN",
    "reaction": "WARN",
    "stop": "WARN",
    "miss": "DEBUG",
    "printed": "DEBUG",
}
"""Log levels by kind of event; INFO for any other."""


class Events:
    """Follows events.jsonl, which the launcher writes line by line."""

    def __init__(
        self, stream: Stream, path: Path, hierarchy: Hierarchy, marks: Marks | None
    ) -> None:
        """Show faults in the hierarchy and, where there is an arm, in 3D by `marks`."""
        self._stream = stream
        self._path = path
        self._hierarchy = hierarchy
        self._marks = marks
        self._read = 0
        self._lanes: dict[str, str] = {}  # what each board's lane shows

    def advance(self) -> None:
        """Write the events that were added."""
        if not self._path.is_file() or self._path.stat().st_size == self._read:
            return
        with self._path.open("rb") as file:
            file.seek(self._read)
            # A line still being written is read the next time.
            lines = [line for line in file.read().splitlines(keepends=True) if line.endswith(b"\n")]
        self._read += sum(map(len, lines))
        for line in lines:
            event = read_line(line.decode())
            # The last line, the outcome of the run, is no event. What the launch waited for, class
            # by class on a slow machine, is no news to who sees the run.
            if "tick" in event and not (event["kind"] == "waiting" and event["tick"] < 0):
                self._write(Event(**event))

    def _write(self, event: Event) -> None:
        board = event.board or RACK
        when = Moment(max(0, event.tick), self._stream.times.monotonic(event.time_ns))
        text = f"{event.kind}: {board}: {event.text}"
        self._stream.say(when, "events", text, LEVELS.get(event.kind, "INFO"))
        if event.kind not in UNSHOWN:
            self._show(when, board, event)
        if event.kind == "fault" and self._marks is not None:
            self._marks.fault(when, event)
        if event.kind == "died":
            self._hierarchy.lose(when, board)
        elif event.code == "hang":
            self._hierarchy.lose(when, event.subject)
        elif event.code == "rejoined":
            self._hierarchy.recover(when, board)

    def _show(self, when: Moment, board: str, event: Event) -> None:
        if board not in self._lanes:
            style_lane(self._stream, (EVENTS, board), EVENT_COLOURS)
        state: str = event.kind
        if event.code == "ends":
            # The end of a fault ends its own span only, not that of a later event.
            if self._lanes.get(board) != state:
                return
            state = ""
        self._lanes[board] = state
        write_span(self._stream, when, (EVENTS, board), state)


def row_losses(stream: Stream) -> Callable[[int, Mapping[str, int]], None]:
    """Return a function that writes, at a tick, how many rows by ring were overwritten before the
    recorder took them; it logs every loss.
    """
    entity = (RECORDER, "rows_lost")
    style_curves(stream, entity, ["rows lost"], [LOST])
    logged = Counter[str]()

    def write(tick: int, lost: Mapping[str, int]) -> None:
        nonlocal logged
        when = stream.times.moment_of(tick)
        counts = Counter(lost)
        for ring, more in (counts - logged).items():
            stream.say(when, "recorder", f"recorder: {more} rows of {ring} lost", "ERROR")
        logged = counts
        stream.at(when, entity, rr.Scalars(counts.total()))

    return write


def recorder_load(stream: Stream) -> Callable[[int], None]:
    """Return a function that writes, at a tick, the load of this process, a recorder, since its
    last call.
    """
    entity = (RECORDER, "load")
    style_curves(stream, entity, ["recorder, % of a core"])
    last = time.process_time(), time.monotonic()

    def write(tick: int) -> None:
        nonlocal last
        now = time.process_time(), time.monotonic()
        cpu_s, wall_s = np.subtract(now, last)
        last = now
        load = rr.Scalars(100.0 * cpu_s / max(wall_s, 1e-9))
        stream.at(stream.times.moment_of(tick), entity, load)

    return write

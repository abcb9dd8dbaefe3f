"""Log lines: the rack's events, from its event log, and the recorder's own losses and load.

Each board also has a lane: the kind of its last event, until the next.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from rack.tools.viewer.levels import Hierarchy
from rack.tools.viewer.stream import Stream
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

    def __init__(self, stream: Stream, path: Path, hierarchy: Hierarchy) -> None:
        self._stream = stream
        self._path = path
        self._hierarchy = hierarchy
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
            self._write(json.loads(line))

    def _write(self, event: dict[str, Any]) -> None:
        kind = event["kind"]
        if "tick" not in event:
            return
        board = event.get("board") or RACK
        code = event.get("code", "")
        tick = max(0, event["tick"])
        stamp_ns = self._stream.times.monotonic(event["time_ns"])
        text = f"{kind}: {board}: {event['text']}"
        self._stream.say(tick, stamp_ns, "events", text, LEVELS.get(kind, "INFO"))
        if kind not in UNSHOWN:
            self._show(tick, stamp_ns, board, kind, code)
        if kind == "died":
            self._hierarchy.lose(tick, stamp_ns, board)
        elif code == "hang":
            self._hierarchy.lose(tick, stamp_ns, event["subject"])
        elif code == "rejoined":
            self._hierarchy.recover(tick, stamp_ns, board)

    def _show(self, tick: int, stamp_ns: int, board: str, kind: str, code: str) -> None:
        if board not in self._lanes:
            style_lane(self._stream, (EVENTS, board), EVENT_COLOURS)
        # The end of a fault ends its own span only, not that of a later event.
        if code == "ends" and self._lanes.get(board) != kind:
            return
        self._lanes[board] = "" if code == "ends" else kind
        write_span(self._stream, tick, stamp_ns, (EVENTS, board), self._lanes[board])


class Losses:
    """Writes how many rows were overwritten before the recorder took them; logs every loss."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._logged: dict[str, int] = {}
        style_curves(stream, (RECORDER, "rows_lost"), ["rows lost"], [LOST])

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Write the losses since the last call."""
        stamp_ns = int(self._stream.times.stamps_of(np.array([tick]))[0])
        for ring, count in lost.items():
            if count > self._logged.get(ring, 0):
                text = f"recorder: {count - self._logged.get(ring, 0)} rows of {ring} lost"
                self._stream.say(tick, stamp_ns, "recorder", text, "ERROR")
        self._logged = dict(lost)
        self._stream.at(tick, stamp_ns, (RECORDER, "rows_lost"), rr.Scalars(sum(lost.values())))


class RecorderLoad:
    """Writes the load of this process: a recorder."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        style_curves(stream, (RECORDER, "load"), ["recorder, % of a core"])
        self._cpu_s = time.process_time()
        self._wall_s = time.monotonic()

    def advance(self, tick: int) -> None:
        """Write the load since the last call."""
        cpu_s = time.process_time()
        wall_s = time.monotonic()
        share = (cpu_s - self._cpu_s) / max(wall_s - self._wall_s, 1e-9)
        self._cpu_s = cpu_s
        self._wall_s = wall_s
        stamp_ns = int(self._stream.times.stamps_of(np.array([tick]))[0])
        self._stream.at(tick, stamp_ns, (RECORDER, "load"), rr.Scalars(100.0 * share))

"""What happened to the rack, from its event log: log lines, and one lane a board of what holds until the next event."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import rerun as rr

from tools.viewer import palette
from tools.viewer.activity import LOG
from tools.viewer.hierarchy import Hierarchy
from tools.viewer.lanes import style_lane, write_span
from tools.viewer.stream import Stream

EVENTS = "events"
RACK = "rack"
"""Lane of events that are of no board."""
LEVELS = {"died": "ERROR", "hang": "ERROR", "printed": "DEBUG", "stop": "WARN"}
LOST = ("died", "hang")


class Events:
    """Follows events.jsonl, which the launcher writes line by line."""

    def __init__(self, stream: Stream, path: Path, hierarchy: Hierarchy) -> None:
        self._stream, self._path, self._hierarchy = stream, path, hierarchy
        self._read = 0
        self._lanes: set[str] = set()

    def advance(self) -> None:
        """Write the events that were added."""
        if not self._path.is_file() or self._path.stat().st_size == self._read:
            return
        with self._path.open("rb") as file:
            file.seek(self._read)
            # A line that is still being written is read the next time.
            lines = [line for line in file.read().splitlines(keepends=True) if line.endswith(b"\n")]
        self._read += sum(map(len, lines))
        for line in lines:
            self._write(json.loads(line))

    def _write(self, event: dict[str, Any]) -> None:
        kind = event["kind"]
        if "tick" not in event:
            return
        board = event.get("board") or RACK
        tick, stamp_ns = max(0, event["tick"]), self._stream.times.monotonic(event["time_ns"])
        line = rr.TextLog(f"{kind}: {board}: {event['text']}", level=LEVELS.get(kind, "INFO"))
        self._stream.at(tick, stamp_ns, (LOG, "events"), line)
        if kind != "printed":
            if board not in self._lanes:
                self._lanes.add(board)
                style_lane(self._stream, (EVENTS, board), palette.EVENTS)
            write_span(self._stream, tick, stamp_ns, (EVENTS, board), kind)
        if kind in LOST:
            self._hierarchy.lose(tick, stamp_ns, board)

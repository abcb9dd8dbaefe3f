"""What the recorder says of itself: rows it lost, and what it costs."""

from __future__ import annotations

import time
from collections.abc import Mapping

import rerun as rr

from rack.tools.viewer.activity import LOG
from rack.tools.viewer.stream import Stream

RECORDER = "recorder"


class Losses:
    """Writes how many rows were overwritten before they could be taken; every loss is a log line too."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._told: dict[str, int] = {}
        stream.static((RECORDER, "rows_lost"), rr.SeriesLines(names=["rows lost"], colors=[(230, 50, 50)]))
        stream.static((RECORDER, "load"), rr.SeriesLines(names=["recorder, % of a core"]))
        self._cpu_s, self._wall_s = time.process_time(), time.monotonic()

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Write the losses and the load up to now."""
        stamp_ns = time.monotonic_ns()
        for ring, count in lost.items():
            if count > self._told.get(ring, 0):
                line = rr.TextLog(f"recorder: {count - self._told.get(ring, 0)} rows of {ring} lost", level="ERROR")
                self._stream.at(tick, stamp_ns, (LOG, "recorder"), line)
        self._told = dict(lost)
        self._stream.at(tick, stamp_ns, (RECORDER, "rows_lost"), rr.Scalars(sum(lost.values())))
        cpu_s, wall_s = time.process_time(), time.monotonic()
        share = (cpu_s - self._cpu_s) / max(wall_s - self._wall_s, 1e-9)
        self._cpu_s, self._wall_s = cpu_s, wall_s
        self._stream.at(tick, stamp_ns, (RECORDER, "load"), rr.Scalars(100.0 * share))

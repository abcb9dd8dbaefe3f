"""Missed cycles of one task: a lane that shows them at any zoom, and log lines."""

from __future__ import annotations

import numpy as np
import rerun as rr

from rack.backplane.layout import TaskSpec
from rack.backplane.trace import Flag
from rack.tools.viewer.levels import LEVELS, LOG
from rack.tools.viewer.stream import RowBlock, Stream
from rack.tools.viewer.style import PHASES, style_lane, write_spans

MISSED = "missed"
SPAN_S = 0.25
"""A missed cycle marks its quarter of a second: itself it would be too narrow to be seen."""


class Misses:
    """Writes trace records: a span wherever cycles were missed, and one log line a block.

    A task that never misses has no lane.
    """

    def __init__(self, stream: Stream, task: TaskSpec) -> None:
        self._stream, self._task = stream, task.name
        self._lane = (LEVELS, task.board, f"{task.role}_{MISSED}")
        self._span = max(1, round(SPAN_S * 1e9 / stream.times.clock_ns))
        self._is_styled = False

    def write(self, block: RowBlock) -> None:
        """Write what was missed."""
        missed = np.flatnonzero(block.rows["flags"] & Flag.MISSED)
        if not len(missed):
            return
        if not self._is_styled:
            style_lane(self._stream, self._lane, {MISSED: PHASES[MISSED]})
            self._is_styled = True
        self._mark(np.unique(block.ticks[missed] // self._span))
        self._log(block.ticks[missed], int(block.stamps_ns[missed[0]]))

    def _mark(self, spans: np.ndarray) -> None:
        ends = np.setdiff1d(spans + 1, spans)
        moments = np.concatenate((spans, ends))
        order = np.argsort(moments)
        ticks = moments[order] * self._span
        states = np.array([MISSED] * len(spans) + [""] * len(ends))[order]
        times = self._stream.times
        write_spans(self._stream, self._lane, times.columns(ticks, times.stamps_of(ticks)), states.tolist())

    def _log(self, ticks: np.ndarray, stamp_ns: int) -> None:
        which = f"tick {ticks[0]}" if len(ticks) == 1 else f"{len(ticks)} cycles, ticks {ticks[0]} to {ticks[-1]}"
        line = rr.TextLog(f"missed: {self._task}: {which}", level="WARN")
        self._stream.at(int(ticks[0]), stamp_ns, (LOG, "misses"), line)

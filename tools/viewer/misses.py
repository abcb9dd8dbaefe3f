"""Missed cycles of one task: a lane that shows them at any zoom, and log lines."""

from __future__ import annotations

import numpy as np
import rerun as rr

from backplane.layout import TaskSpec
from backplane.trace import Flag
from tools.viewer.activity import LEVELS, LOG
from tools.viewer.blocks import Block, Changes
from tools.viewer.lanes import style_lane, write_spans
from tools.viewer.palette import PHASES
from tools.viewer.stream import Stream

MISSED = "missed"


class Misses:
    """Writes trace records: a span as long as cycles are missed one after the other, and one log line a block."""

    def __init__(self, stream: Stream, task: TaskSpec) -> None:
        self._stream, self._task = stream, task.name
        self._lane = (LEVELS, task.board, f"{task.role}_{MISSED}")
        self._changes = Changes()
        self._any = False

    def write(self, block: Block) -> None:
        """Write what was missed; a task that never misses has no lane."""
        missed = (block.rows["flags"] & Flag.MISSED) > 0
        changed = self._changes.rows(missed)
        if not self._any and not missed.any():
            return
        if not self._any:
            style_lane(self._stream, self._lane, {MISSED: PHASES[MISSED]})
        self._any = True
        if len(changed):
            times = self._stream.times.columns(block.ticks[changed], block.stamps_ns[changed])
            write_spans(self._stream, self._lane, times, [MISSED if at else "" for at in missed[changed]])
        if missed.any():
            self._log(block, np.flatnonzero(missed))

    def _log(self, block: Block, missed: np.ndarray) -> None:
        ticks = block.ticks[missed]
        which = f"tick {ticks[0]}" if len(ticks) == 1 else f"{len(ticks)} cycles, ticks {ticks[0]} to {ticks[-1]}"
        line = rr.TextLog(f"missed: {self._task}: {which}", level="WARN")
        self._stream.at(int(ticks[0]), int(block.stamps_ns[missed[0]]), (LOG, "misses"), line)

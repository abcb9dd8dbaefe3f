"""The times of one task against its deadline, as curves."""

from __future__ import annotations

import numpy as np
import rerun as rr

from rack.backplane.layout import TaskSpec
from rack.tools.viewer.stream import RowBlock, Stream
from rack.tools.viewer.style import LIMIT, of_joint

LOAD, TIMES = "load", "times"


class Load:
    """Writes trace records: lateness, execution and deadline in ms, and the part of the time slice that is used up.

    In lockstep a tick lasts as long as its tasks take: there is execution alone, and nothing that it is held against.
    """

    def __init__(self, stream: Stream, task: TaskSpec, period_ns: int, is_lockstep: bool) -> None:
        self._stream, self._task, self._is_lockstep = stream, task.name, is_lockstep
        self._slice_ns = task.every * task.within_cycles * period_ns
        curves = [f"{task.name} {name}" for name in ("lateness, ms", "execution, ms", "deadline, ms")]
        stream.static((TIMES, task.name), rr.SeriesLines(names=curves, colors=[of_joint(1), of_joint(0), LIMIT]))
        stream.static((LOAD, task.name), rr.SeriesLines(names=[f"{task.name}, %"]))

    def write(self, block: RowBlock) -> None:
        """Write every cycle; 100 % is the deadline."""
        rows = block.rows
        lateness = rows["start_ns"] - rows["release_ns"]
        execution = rows["process_ns"] - rows["read_ns"]
        curves = np.column_stack((lateness, execution, np.full(len(rows), self._slice_ns))) * 1e-6
        if self._is_lockstep:
            curves[:, [0, 2]] = np.nan
        self._stream.scalars((TIMES, self._task), block.times, curves)
        if self._is_lockstep:
            return
        used = (rows["end_ns"] - rows["release_ns"]) * (100.0 / self._slice_ns)
        self._stream.scalars((LOAD, self._task), block.times, used)

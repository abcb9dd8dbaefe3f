"""The Gantt lane of one task: what its board does in every cycle, from the trace."""

from __future__ import annotations

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.backplane.trace import Flag
from rack.tools.viewer.stream import RowBlock, Stream
from rack.tools.viewer.style import PHASES, style_lane, write_spans

BOARDS = "boards"
MOMENTS = ("start_ns", "read_ns", "process_ns", "end_ns")


def lane_of(task: TaskSpec) -> tuple[str, ...]:
    """Return the lane of a task; lanes stand in the order of slots."""
    return (BOARDS, f"{task.slot}-{task.board}", task.role)


class CycleLanes:
    """Writes trace records as spans: read, process or plan, write, wait. What was missed is red.

    In real time a span lies where it was on the wall clock, scaled to simulated time. In lockstep, where the wall
    clock stands still for simulated time, it begins at its tick and is cut at the end of its time slice.
    """

    def __init__(self, stream: Stream, task: TaskSpec, speed: float, lockstep: bool) -> None:
        self._stream, self._speed = stream, speed
        self._lane = lane_of(task)
        self._last_ns = task.every * task.within_cycles * stream.times.clock_ns - len(MOMENTS) if lockstep else None
        self._work = "process" if task.role == "executor" else "plan"
        style_lane(stream, self._lane, PHASES, quiet=["wait"])

    def write(self, block: RowBlock) -> None:
        """Write four spans a cycle."""
        rows = block.rows
        moments = np.stack([rows[name] for name in MOMENTS], axis=1)
        within = ((moments - rows["release_ns"][:, None]) * self._speed).astype(np.int64)
        if self._last_ns is not None:
            # Cut spans keep an order: no two of a lane begin at once.
            within = np.minimum(within, self._last_ns + np.arange(len(MOMENTS)))
        ticks = np.repeat(block.ticks, len(MOMENTS))
        states = np.array([["read", self._work, "write", "wait"]] * len(rows))
        states[(rows["flags"] & Flag.MISSED) > 0, :3] = "missed"
        times = self._stream.times.columns(ticks, moments.ravel(), within.ravel())
        write_spans(self._stream, self._lane, times, states.ravel().tolist())

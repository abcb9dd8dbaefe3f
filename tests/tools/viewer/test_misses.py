"""Missed cycles in the recording for the viewer."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import rerun.blueprint as rrb

from rack.backplane.layout import TaskSpec
from rack.backplane.segment import Launch
from rack.backplane.trace import RECORD, Flag
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.stream import RowBlock, Stream, Timelines, open_recording
from rack.tools.viewer.timing import build_miss_lines

TICK_NS = 2_500_000
TASK = TaskSpec("servo", "servo", "executor", 2, 0, 0, 1, 1, 4)


def recorded(folder: Path, missed: list[list[int]]) -> Path:
    """Write blocks of 400 cycles with misses at these ticks."""
    times = Timelines(TICK_NS, Launch(time.time_ns(), 0))
    stream = Stream(open_recording("misses", "run", folder / "run.rrd", rrb.Blueprint()), times)
    write = build_miss_lines(stream, TASK)
    for number, ticks in enumerate(missed):
        rows = np.zeros(400, dtype=RECORD)
        rows["tick"] = np.arange(400) + 400 * number
        rows["start_ns"] = rows["tick"] * TICK_NS
        rows["flags"][np.array(ticks, dtype=int) - 400 * number] = Flag.MISSED
        write(RowBlock(rows, times))
    stream.flush()
    stream.close()
    return folder / "run.rrd"


def test_missed_cycles_are_in_the_log_a_line_a_block(tmp_path: Path) -> None:
    file = recorded(tmp_path, [[5, 120, 130], [], [1199]])
    log = read_component(file, "/log/misses", "TextLog:text").values.ravel().tolist()
    assert log == [
        "tick 5: missed: servo: 3 cycles, ticks 5 to 130",
        "tick 1199: missed: servo: tick 1199",
    ]

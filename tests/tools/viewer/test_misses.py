"""Missed cycles in the recording for the viewer."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.backplane.trace import RECORD, Flag
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.timing import build_miss_lines
from tests.tools.viewer.streams import open_stream

TICK_NS = 2_500_000
TASK = TaskSpec("servo", "servo", "executor", 2, 0, 0, 1, 1, 4)


def test_missed_cycles_are_in_the_log_a_line_a_block(tmp_path: Path) -> None:
    with open_stream(tmp_path / "run.rrd", TICK_NS, time.time_ns()) as opened:
        write = build_miss_lines(opened.stream, TASK)
        for number, ticks in enumerate(([5, 120, 130], [], [1199])):
            rows = np.zeros(400, dtype=RECORD)
            rows["tick"] = np.arange(400) + 400 * number
            rows["start_ns"] = rows["tick"] * TICK_NS
            rows["flags"][np.array(ticks, dtype=int) - 400 * number] = Flag.MISSED
            write(opened.block(rows))
    log = read_component(tmp_path / "run.rrd", "/log/misses", "TextLog:text").values
    assert log.ravel().tolist() == [
        "tick 5: missed: servo: 3 cycles, ticks 5 to 130",
        "tick 1199: missed: servo: tick 1199",
    ]

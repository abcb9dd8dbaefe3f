"""Missed cycles in the recording for the viewer."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb

from rack.backplane.layout import TaskSpec
from rack.backplane.segment import Launch
from rack.backplane.trace import RECORD, Flag
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.stream import RowBlock, Stream, Timelines, open_recording
from rack.tools.viewer.timing import build_miss_lane

TICK_NS = 2_500_000
SPAN = 100
TASK = TaskSpec("servo", "servo", "executor", 2, 0, 0, 1, 1, 4)


def recorded(folder: Path, missed: list[list[int]]) -> Path:
    """Write blocks of 400 cycles with misses at these ticks."""
    times = Timelines(TICK_NS, Launch(time.time_ns(), 0))
    stream = Stream(open_recording("misses", "run", folder / "run.rrd", rrb.Blueprint()), times)
    write = build_miss_lane(stream, TASK, "1-servo")
    for number, ticks in enumerate(missed):
        rows = np.zeros(400, dtype=RECORD)
        rows["tick"] = np.arange(400) + 400 * number
        rows["start_ns"] = rows["tick"] * TICK_NS
        rows["flags"][np.array(ticks, dtype=int) - 400 * number] = Flag.MISSED
        write(RowBlock(rows, times))
    stream.flush()
    stream.close()
    return folder / "run.rrd"


def test_a_missed_cycle_marks_its_quarter_of_a_second_and_is_in_the_log(tmp_path: Path) -> None:
    file = recorded(tmp_path, [[5, 120, 130], [], [1199]])
    lane = read_component(file, "/missed/1-servo", "StateChange:state")
    assert lane.ticks.tolist() == [0, SPAN, 2 * SPAN, 11 * SPAN, 12 * SPAN]
    assert lane.values.ravel().tolist() == ["missed", "missed", "", "missed", ""]
    log = read_component(file, "/log/misses", "TextLog:text").values.ravel().tolist()
    assert log == [
        "tick 5: missed: servo: 3 cycles, ticks 5 to 130",
        "tick 1199: missed: servo: tick 1199",
    ]


def test_a_task_that_never_misses_has_no_lane(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="missed/1-servo"):
        read_component(recorded(tmp_path, [[], []]), "/missed/1-servo", "StateChange:state")

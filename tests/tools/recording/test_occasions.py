"""The occasions around which a flight recorder keeps everything."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.trace import RECORD, SKIPPED_SHIFT, Flag
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.boards import Rack
from rack.boards.config import load
from rack.tools.recording.occasions import Occasions, Retention
from rack.tools.recording.spool import open_rings

pytestmark = pytest.mark.thorough


def build_trace(flags: list[int]) -> np.ndarray:
    """Return trace records with these flags, from tick 100 on."""
    rows = np.zeros(len(flags), RECORD)
    rows["tick"] = 100 + np.arange(len(flags))
    rows["flags"] = flags
    return rows


def test_misses_holds_and_alarms_except_commands_are_occasions(small: Path, rack_name: str) -> None:
    record = "record={ keep = '10 s', before = '1 s', after = '2 s' }"
    with Rack(load(small, [f"name={rack_name}", record])) as rack:
        segment = rack.segment
        occasions = Occasions(segment)
        assert list(occasions.find_alarm_ticks()) == []

        def find(ring: str, rows: np.ndarray) -> list[int]:
            return list(occasions.find_occasion_ticks(ring, rows))

        assert find("lower", build_trace([0, 0])) == []
        assert find("lower", build_trace([0, Flag.MISSED, 0, 1 << SKIPPED_SHIFT])) == [101, 103]
        rack.run(0.1)
        status = open_rings(segment)["lower.status"].read_new_rows().rows.copy()
        status["message"]["state"] = State.EXECUTING
        ticks = status["tick"].tolist()
        assert find("lower.status", status) == []
        # A hold begins, lasts beyond the end of the drained rows, and ends.
        status["message"]["state"][-3:] = State.HOLDING
        assert find("lower.status", status) == [ticks[-3]]
        status["message"]["state"][:2] = State.HOLDING
        status["message"]["state"][-3:] = State.EXECUTING
        assert find("lower.status", status) == [ticks[2]]
        bell = AlarmWriter(segment, "upper")
        for tick, alarm in ((7, Alarm.COLLISION), (8, Alarm.COMMANDED), (9, Alarm.REJOINED)):
            bell.raise_alarm(tick, alarm)
        assert list(occasions.find_alarm_ticks()) == [7, 9]
        assert list(occasions.find_alarm_ticks()) == []
        keeping = Retention.from_config(segment)
        assert keeping is not None
        assert keeping.find_window(100) == (0, 900)
        assert keeping.find_window(1000) == (600, 1800)

"""What the full screen measures: shares of a time slice, lateness, commands in work."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.segment import Segment, unlink
from rack.backplane.trace import RECORD
from rack.backplane.words import System
from rack.boards.config import load, wire
from rack.tools.live.gauges import LATE_US, Gauges

TICK_NS = 2_500_000


@pytest.fixture
def segment(small: Path, rack_name: str) -> Iterator[Segment]:
    config = load(small, [f"name={rack_name}"])
    made = Segment.create(wire(config), config.text())
    made.words[System.PERIOD_NS] = TICK_NS
    yield made
    made.close()
    unlink(rack_name)


def cycles(*late_us: float) -> np.ndarray:
    """Return cycles that begin so late, execute for 1 ms and communicate for 0.5 ms."""
    rows = np.zeros(len(late_us), RECORD)
    rows["start_ns"] = np.array(late_us) * 1e3
    rows["read_ns"] = rows["start_ns"] + 300_000
    rows["process_ns"] = rows["read_ns"] + 1_000_000
    rows["end_ns"] = rows["process_ns"] + 200_000
    return rows


def test_a_bar_shows_execution_communication_and_residual_time(segment: Segment) -> None:
    gauges = Gauges(segment)
    assert gauges.bar("lower") == "·······"
    gauges.take({"lower": cycles(10.0, 20.0), "upper": cycles(10.0)})
    # 40 % and 20 % of 2.5 ms in seven characters; of 20 ms 5 % and 2.5 %.
    assert [gauges.bar(task) for task in ("lower", "upper")] == ["███▒▒··", "█▒·····"]


def test_lateness_is_counted_until_it_is_forgotten(segment: Segment) -> None:
    gauges = Gauges(segment)
    gauges.take({"lower": cycles(-5.0, 19.0, 20.0, 700.0)})
    gauges.take({"lower": cycles(30_000.0)})
    counts = dict(zip(LATE_US[1:], gauges.late["lower"], strict=True))
    assert (counts[20], counts[50], counts[1_000], counts[np.inf]) == (2, 1, 1, 1)
    assert gauges.worst_ms["lower"].tolist() == [30.0, 1.0]
    gauges.reset()
    assert (gauges.late["lower"].sum(), gauges.worst_ms["lower"].max()) == (0, 0.0)


def test_the_command_in_work_is_that_of_the_newest_status(segment: Segment) -> None:
    gauges = Gauges(segment)
    writer = open_writer(segment, "upper.status")
    seen = []
    for second, echo in ((0, 0), (1, 7), (2, 7), (3, 9), (4, 9)):
        writer.message.echo = echo
        writer.write(400 * second)
        gauges.take({})
        seen.append(gauges.work("upper"))
    writer.close()
    assert seen == ["", "7 1s", "7 1s", "9 3s", "9 3s"]
    late = Gauges(segment)
    late.take({})
    assert late.work("upper") == "9 3s"


def test_mailboxes_have_rates_and_ages(segment: Segment) -> None:
    gauges = Gauges(segment)
    writer = open_writer(segment, "upper.status")
    for tick in range(0, 400, 8):
        writer.write(tick)
    segment.words[System.TICK] = 400
    writer.close()
    found = {name: figures for name, _, _, *figures in gauges.traffic()}
    assert found["upper.status"] == ["0.020", "50.0"]
    assert found["lower.status"] == ["-", "0.0"]

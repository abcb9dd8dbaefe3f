"""Tests interrupts in `rack status`, in the report of a run, and message by message."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.tools.monitor.interrupts import replay_inbox
from rack.tools.report.report import write_report
from tests.boards.messages import Written
from tests.boards.run.test_interrupts import BOARDS, OVERLOADED, RACK, SECONDS, SMALL, TICKS
from tests.tools.recordings import recorded


@pytest.mark.slow
@pytest.mark.parametrize("settings", [(SMALL,), (SMALL, OVERLOADED)], ids=["burst", "overload"])
def test_recording_and_report_agree_with_the_inbox_of_the_board(
    tmp_path: Path, rack_name: str, settings: tuple[str, ...]
) -> None:
    path = tmp_path / "hub.toml"
    path.write_text(RACK)
    config = load(path, [f"name={rack_name}", *settings])
    # No recorder process is started.
    with Rack(config) as rack:
        rack.run(SECONDS)
        found = Written.on(rack.segment)
    traces = {task: rows.tolist() for task, rows in found.cycles.items()}
    recording = recorded(tmp_path / "run", config, traces, messages=found.messages)
    slot = recording.layout.find_task("hub").slot
    arrivals = replay_inbox(recording, slot)
    names = [box.name for box in recording.layout.list_interrupting_mailboxes(slot)]
    had = recording.read_signal("hub.status", "cycle")
    for at in range(BOARDS):
        ends = arrivals.end_ns[arrivals.mailbox == names.index(f"figure{at}.status")]
        shown = [np.flatnonzero(ends <= tick * recording.layout.clock_ns) for tick in range(TICKS)]
        # A board writes in every tick, so the number of a message is its tick.
        assert had[:, at].tolist() == [found[-1] if len(found) else -1 for found in shown]
    if OVERLOADED in settings:
        return
    report, text = write_report(tmp_path / "run")
    (inbox,) = report["interrupts"]
    assert (inbox["board"], inbox["depth"], inbox["waiting"]) == ("hub", 2, 2)
    assert (inbox["served"], inbox["lost"]) == (3 * TICKS, 2 * TICKS)
    assert inbox["latency_us"]["max"] == 3 * inbox["latency_us"]["min"]
    assert "## Interrupts of boards: 1" in text.splitlines()

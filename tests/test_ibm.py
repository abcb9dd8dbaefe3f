"""The rack ibm, with real processes in lockstep: what brakes the arm on the way down is no
touch."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rack.boards.config import load
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.recording import Recording
from rack.tools.report.report import write_report

pytestmark = pytest.mark.thorough

GUARDED = (7, 16)
"""Numbers of the requests that lower the blocks."""
TOUCHES = (0.4735, 0.5236)
"""Heights of the tool at which the blocks stand, m; a braking just before lets it press some mm
further."""
MUTES = [*(("servo", at) for at in np.arange(8.25, 27.0, 0.5)), ("motion", 10.0), ("motion", 19.5)]
"""Boards that write nothing for five cycles, and when, s: enough of them come while a block is
lowered."""


@pytest.mark.slow
def test_brakings_while_each_block_is_lowered_count_as_no_touch_and_each_is_put_down(
    tmp_path: Path,
) -> None:
    script = tmp_path / "mutes.toml"
    faults = [
        f'[[fault]]\nkind = "mute"\nboard = "{board}"\nat = {at}\ncycles = 5\n'
        for board, at in MUTES
    ]
    script.write_text("\n".join(faults))
    config = load("ibm", [f"name=test-ibm-{os.getpid()}", "clock.mode=lockstep"], str(script))
    assert run_rack(config, None, tmp_path / "run", Display()).recording == "complete"
    recording = Recording(tmp_path / "run")
    ticks, current = (
        recording.read_signal("motion.status", field) for field in ("tick", "current")
    )
    braked = recording.read_signal("arm.status", "tick")[
        recording.read_signal("arm.status", "braked") == 1
    ]
    for request in GUARDED:
        lowering = ticks[current == request]
        assert len(set(braked) & set(range(lowering[0] + 1000, lowering[-1] - 500)))

    printed = [event["text"] for event in recording.events if event["kind"] == "printed"]
    assert ["touched" in text for text in printed] == [True, True]
    assert [float(text.split()[-2]) for text in printed] == pytest.approx(TOUCHES, abs=4e-3)
    report = write_report(recording.folder)[0]
    assert (report["worked"], report["outcome"]["cause"]) == (True, "task done")
    assert [end["object"] for end in report["objects"]] == ["block1", "block2"]
    assert all(end["off_mm"] < 5.0 and end["drops"] == [] for end in report["objects"])

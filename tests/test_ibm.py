"""The rack ibm, with real processes in lockstep: what brakes the arm on the way down is no
touch."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.boards.config import load
from rack.tools.live.display import Display
from rack.tools.live.launch import run_rack
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.report import write_report

pytestmark = pytest.mark.thorough

GUARDED = (7, 16)
"""Numbers of the requests that lower the blocks."""
TOUCHES = (0.4735, 0.5236)
"""Heights of the tool at which the blocks stand, m; a braking just before lets it press some mm
further."""
MUTES = [*(("servo", at) for at in np.arange(8.25, 27.0, 0.5)), ("motion", 10.0), ("motion", 19.5)]
"""Boards that write nothing for five cycles, and when, s: enough of them come while a block is
lowered."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a run whose arm is braked again and again, and its report."""
    folder = tmp_path_factory.mktemp("ibm")
    script = folder / "mutes.toml"
    faults = [
        f'[[fault]]\nkind = "mute"\nboard = "{board}"\nat = {at}\ncycles = 5\n'
        for board, at in MUTES
    ]
    script.write_text("\n".join(faults))
    config = load("ibm", [f"name=test-ibm-{os.getpid()}", "clock.mode=lockstep"], str(script))
    result = run_rack(config, None, folder / "run", Display())
    assert result.recording == "complete"
    return folder / "run", write_report(folder / "run")[0]


@pytest.mark.slow
def test_the_arm_was_braked_while_each_block_was_lowered(run: tuple[Path, dict[str, Any]]) -> None:
    recording = Recording(run[0])
    ticks, current = (recording.signal("motion.status", field) for field in ("tick", "current"))
    braked = recording.signal("arm.status", "tick")[recording.signal("arm.status", "braked") == 1]
    for request in GUARDED:
        lowering = ticks[current == request]
        assert len(set(braked) & set(range(lowering[0] + 1000, lowering[-1] - 500)))


@pytest.mark.slow
def test_no_braking_counts_as_touch_and_each_block_is_put_down(
    run: tuple[Path, dict[str, Any]],
) -> None:
    printed = [event["text"] for event in Recording(run[0]).events if event["kind"] == "printed"]
    assert ["touched" in text for text in printed] == [True, True]
    assert [float(text.split()[-2]) for text in printed] == pytest.approx(TOUCHES, abs=4e-3)
    report = run[1]
    assert report["worked"]
    assert report["outcome"]["cause"] == "task done"
    ends = {end["object"]: end for end in report["objects"]}
    assert list(ends) == ["block1", "block2"]
    for end in ends.values():
        assert end["off_mm"] < 5.0
        assert end["drops"] == []

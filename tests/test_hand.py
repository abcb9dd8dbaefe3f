"""A hand in a rack of real processes, in lockstep: its board is killed while an object
is pushed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rack.boards.config import load
from tests.levels.arms import ROBOTS
from tests.shared_runs import record

SECONDS, KILLED_S = 0.5, 0.2
RACK = f"""
format = 2
name = "test-hand-{os.getpid()}"
extends = ["{ROBOTS / "utah_mit.toml"}"]

[clock]
period_ms = 0.5
mode = "lockstep"

[supervision]
lockstep_restart_s = 0.05

[board.hand]
slot = 2
rate_hz = 500
above = "swing"
executor = "rack.levels.systems.hand.executor:HandExecutor"

[board.swing]
slot = 3
rate_hz = 500
below = "hand"
executor = "tests.levels.systems.hand.hand_rig:Swing"

[[scene.push]]
body = "can"
at = 0.1
seconds = 0.2
force = [0.3, 0.0, 0.5]

[[fault]]
kind = "kill"
board = "hand"
at = {KILLED_S}
"""


@pytest.mark.slow
def test_restarted_board_goes_on_with_the_hand_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "hand.toml").write_text(RACK)
    run = record(load(tmp_path / "hand.toml"), SECONDS, tmp_path / "run")
    tick, position, stopped = (
        run.read_signal("hand.status", name) for name in ("tick", "position", "stopped")
    )
    gap = int(np.diff(tick).argmax())
    assert tick[gap] * 5e-4 == pytest.approx(KILLED_S, abs=0.005)
    assert np.diff(tick).max() * 5e-4 > 0.04
    assert np.abs(position[gap + 1] - position[gap]).max() < 0.05
    assert not stopped[:gap].any()
    assert stopped[gap + 1]
    assert not stopped[-50:].any()  # it follows again
    assert np.abs(position[-1] - position[-50]).max() > 0.01

"""The rack rccl, with real processes in lockstep: its planner stalls, and the arm finishes its
queue and holds."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import State
from rack.boards.config import load
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.recording import Recording

pytestmark = pytest.mark.thorough

SECONDS = 6.0
STALL = """
[[fault]]
kind = "hang"
board = "planning.planner"
at = 1.0
for = 0.5
"""
LASTS = "supervision.lockstep_restart_s=1.5"  # the hang is found after half a second


def test_a_stalled_planner_leaves_the_arm_holding_at_its_last_goal_without_a_step(
    tmp_path: Path,
) -> None:
    script = tmp_path / "stall.toml"
    script.write_text(STALL)
    name = f"name=test-rccl-{os.getpid()}"
    settings = [name, "clock.mode=lockstep", LASTS, "board.planning.params.ahead=1"]
    config = load("rccl", settings, str(script))
    assert run_rack(config, SECONDS, tmp_path / "run", Display()).recording == "complete"
    run = Recording(tmp_path / "run")
    tick, done, resting, state = (
        run.read_signal("trajectory.status", name) for name in ("tick", "done", "resting", "state")
    )
    stalled = (tick >= 2300) & (tick < 2900)
    assert (done[stalled] == 1).all()
    assert resting[stalled].all()
    assert (state[stalled] == State.DONE).all()
    assert done[-1] >= 3
    position, target, violations, touches = (
        run.read_signal("arm.status", name)
        for name in ("position", "target", "violations", "touches")
    )
    assert np.abs(position - target).max() < 2e-3
    assert violations[-1] == touches[-1] == 0
    steps = np.diff(target[10:], 2, axis=0)
    # rad/s2: twice the greatest acceleration of a joint.
    assert np.abs(steps).max() * 1e6 < 2.0 * 12.0
    assert np.abs(np.diff(target[10:], axis=0)).max() > 2e-4

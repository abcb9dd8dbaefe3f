"""The rack rccl, with real processes in lockstep: its planner stalls, and the arm finishes its
queue and holds."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from rack.backplane.message import State
from rack.boards.config import load
from rack.tools.live.display import Display
from rack.tools.live.launch import run_rack

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


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rccl")
    script = folder / "stall.toml"
    script.write_text(STALL)
    settings = [
        f"name=test-rccl-{os.getpid()}",
        "clock.mode=lockstep",
        LASTS,
        "board.planning.params.ahead=1",
    ]
    result = run_rack(load("rccl", settings, str(script)), SECONDS, folder / "run", Display())
    assert result.recording == "complete"
    return folder / "run"


def table(run: Path, mailbox: str, *fields: str) -> list[np.ndarray]:
    """Return the columns of a mailbox: tick, then `fields`."""
    rows = pq.read_table(run / "signals" / f"{mailbox}.parquet")
    return [np.array(rows[name].to_pylist()) for name in ("tick", *fields)]


def test_a_stalled_planner_leaves_the_arm_holding_at_its_last_goal(run: Path) -> None:
    tick, done, resting, state = table(run, "trajectory.status", "done", "resting", "state")
    stalled = (tick >= 2300) & (tick < 2900)
    assert (done[stalled] == 1).all()
    assert resting[stalled].all()
    assert (state[stalled] == State.DONE).all()
    assert done[-1] >= 3


def test_the_arm_follows_without_a_step_and_within_its_limits(run: Path) -> None:
    _, position, target, violations, touches = table(
        run, "arm.status", "position", "target", "violations", "touches"
    )
    assert np.abs(position - target).max() < 2e-3
    assert violations[-1] == touches[-1] == 0
    steps = np.diff(target[10:], 2, axis=0)
    assert np.abs(steps).max() * 1e6 < 2.0 * np.array([4.0, 3.5, 6.0, 12.0, 12.0, 12.0]).max()
    assert np.abs(np.diff(target[10:], axis=0)).max() > 2e-4

"""Hybrid control under a trajectory level: a tool that presses on a table and slides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.level import Demand
from tests.levels.box import hold_back, mute
from tests.levels.systems.force.hybrid_rig import START, HybridRig

WANTED_N = 20.0


def pressing(folder: Path, **gains: float) -> HybridRig:
    """Return a rig whose tool has come down and presses on the table."""
    rig = HybridRig(folder, start=(START[0], START[1], START[2] - 0.015), **gains)
    rig.run(0.2)
    rig.comply(-WANTED_N)
    rig.run(1.2)
    return rig


def pressed(rig: HybridRig, seconds: float) -> np.ndarray:
    """Return the forces on the tool along z in the last `seconds`, N."""
    return np.array(rig.forces)[-round(seconds * 1e3) :, 2]


@pytest.mark.slow
def test_a_force_settles_is_kept_along_a_motion_and_ends_without_a_step(tmp_path: Path) -> None:
    rig = pressing(tmp_path)
    assert np.abs(pressed(rig, 0.2) - WANTED_N).max() < 0.5
    assert pressed(rig, 1.2).max() < 1.1 * WANTED_N
    assert rig.force.wanted[2] == -WANTED_N
    assert rig.force.wrench[2] == pytest.approx(WANTED_N, abs=0.5)
    assert rig.force.offset[2] < -0.005
    assert (rig.force.state, rig.force.reason) == (State.EXECUTING, "")
    rig.line((START[0], START[1] + 0.08, START[2] - 0.015), segment=0.8)
    rig.run(1.6)
    assert np.abs(pressed(rig, 1.6) - WANTED_N).max() < 3.0
    assert np.abs(rig.tool[:2] - (START[0], START[1] + 0.08)).max() < 1e-3
    assert rig.motion.reason == ""
    rig.line((START[0], START[1], START[2] - 0.015), segment=0.8)
    rig.run(0.6)
    rig.comply(None)
    rig.run(1.0)
    assert max(rig.steps()) < 1.2
    assert np.abs(pressed(rig, 0.2)).max() < WANTED_N + 5.0
    assert abs(rig.tool[1] - START[1]) < 1e-3
    away = rig.status.target - rig.output("trajectory", "command").position
    assert 1e-3 < np.abs(away).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("axis", [1, 2])
def test_a_struck_guard_ends_the_motion_once(tmp_path: Path, axis: int) -> None:
    guard = np.zeros(6)
    guard[axis] = 8.0
    start = (START[0], START[1], START[2] - 0.015)
    rig = HybridRig(tmp_path, start=start)
    rig.run(0.2)
    if axis == 1:  # sliding: friction is felt along y
        rig.comply(-2.0 * WANTED_N)
        rig.run(1.0)
    command = rig.comply(-2.0 * WANTED_N if axis == 1 else None, guard=guard)
    way = (
        (start[0], start[1] + 0.1, start[2]) if axis == 1 else (start[0], start[1], start[2] - 0.05)
    )
    rig.line(way, segment=2.0)
    rig.run(0.8)
    assert (rig.force.struck, rig.force.axis) == (command, axis)
    assert rig.force.reason == f"guard of axis {'xyz'[axis]} was struck: held until another command"
    assert rig.status.holding
    rest = rig.tool
    rig.run(0.2)
    assert np.abs(rig.tool - rest).max() < 2e-3
    assert max(rig.steps()) < 1.2
    if axis == 1:
        assert abs(rig.forces[-1][2] - 2.0 * WANTED_N) < 4.0
        return
    rig.rack.lose("hybrid", ticks=20)
    rig.run(0.3)
    assert (rig.force.struck, rig.force.axis) == (command, axis), "a restarted board strikes none"
    assert rig.force.reason.startswith("guard of axis z was struck")
    rig.comply(None)
    rig.line((START[0], START[1], START[2] + 0.02), segment=0.5)
    rig.run(1.5)
    assert rig.force.reason == ""


@pytest.mark.slow
def test_force_axes_rest_while_the_wrench_is_not_fresh_or_the_level_above_is_lost(
    tmp_path: Path,
) -> None:
    rig = pressing(tmp_path)
    silent = "no wrench from the board of the arm: waiting for it"
    stale = "wrench is stale, 21 ticks: waiting for the board of the arm"
    for disturbance, reason, wanted in (
        (mute, silent, 2.0 * WANTED_N),
        (hold_back(20), stale, WANTED_N),
    ):
        rig.rack.disturb("arm.wrench", disturbance, ticks=300)
        rig.run(0.05)
        rig.comply(-wanted)
        rig.run(0.15)
        held = rig.status.target.copy()
        assert rig.force.reason == reason
        assert (rig.force.state, rig.status.state) == (State.HOLDING, State.HOLDING)
        rig.run(0.05)
        assert np.abs(rig.status.target - held).max() < 1e-6
        rig.run(1.5)
        assert np.abs(pressed(rig, 0.1) - wanted).max() < 2.0
    rig.rack.boxes["trajectory.compliance"].lost = True
    rig.comply(-2.0 * WANTED_N)
    rig.run(0.3)
    assert rig.force.reason == "no command from the level above: held until its board is back"
    assert np.abs(pressed(rig, 0.1) - WANTED_N).max() < 5.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "value"), [("frame", (0.0, 0.0, 0.0, 0.0)), ("wrench", (np.nan,) * 6)]
)
def test_an_impossible_command_is_refused(
    tmp_path: Path, field: str, value: Sequence[float]
) -> None:
    rig = HybridRig(tmp_path)
    rig.run(0.1)
    setattr(rig.compliance, field, value)
    rig.compliance.id, rig.compliance.active, rig.compliance.selected[2] = 1, 1, 1
    rig.rack.write("trajectory.compliance", rig.compliance)
    rig.run(0.1)
    assert rig.force.reason.startswith("compliance 1 rejected: ")
    assert np.abs(rig.status.target - rig.cell.home).max() < 1e-6
    # One beyond the arm's limit is cut.
    rig.compliance.frame = (1.0, 0.0, 0.0, 0.0)
    rig.comply(-90.0, speed=0.001)
    rig.run(0.1)
    assert rig.force.wanted[2] == -60.0
    assert rig.force.reason == "force of 90 N is wanted, 60 applied: the arm's limit on contacts"
    assert not rig.status.holding


@pytest.mark.slow
def test_after_a_restart_and_after_the_brakes_the_motion_begins_where_the_arm_is(
    tmp_path: Path,
) -> None:
    rig = pressing(tmp_path)
    rig.rack.lose("hybrid", ticks=100)
    rig.run(1.2)
    assert np.abs(pressed(rig, 1.2) - WANTED_N).max() < 10.0
    assert np.abs(pressed(rig, 0.1) - WANTED_N).max() < 1.0
    assert max(rig.steps()) < 1.2
    rig.rack.stop(Demand.BRAKE, ticks=200)
    rig.run(0.1)
    assert rig.status.stopped
    assert rig.status.reason.startswith("waiting for servo: ")
    rig.run(1.5)
    assert not rig.status.stopped
    assert np.abs(pressed(rig, 0.1) - WANTED_N).max() < 1.0

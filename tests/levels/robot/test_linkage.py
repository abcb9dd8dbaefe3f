"""Grippers whose joints follow one that is driven: geared, in closed loops."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from rack.levels.errors import RobotError
from rack.levels.robot.cell import Cell, build_cell
from tests.levels.arms import CLOCK_NS
from tests.levels.robot.grippers import four_bar


def build_linkage_cell(folder: Path, old: str = "", new: str = "") -> Cell:
    """Return the cell with the four-bar gripper, with one change to its model."""
    robot, scene = four_bar(folder)
    arm = folder / "puma560.xml"
    arm.write_text(arm.read_text().replace(old, new, 1) if old else arm.read_text())
    return build_cell(robot, scene, CLOCK_NS)


def compute_deviation(made: Cell, data: mujoco.MjData) -> float:
    """Return how far the farthest joint is from where the linkage puts it, rad."""
    assert made.gripper is not None
    posed = np.array(data.qpos)
    made.gripper.linkage.set_opening(posed, float(data.qpos[made.gripper.linkage.driven]))
    return float(np.max(np.abs(posed - data.qpos)[made.gripper.linkage.joints]))


def test_closed_loops_are_posed_as_the_simulation_settles(tmp_path: Path) -> None:
    made = build_linkage_cell(tmp_path)
    assert made.gripper is not None
    assert len(made.gripper.linkage.joints) == 5
    assert compute_deviation(made, made.build_start_data()) == 0.0
    data = made.build_start_data()
    data.qpos[made.gripper.linkage.driven] = 0.35
    made.gripper.linkage.set_opening(data.qpos, 0.35)
    mujoco.mj_forward(made.model, data)
    equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    assert np.abs(data.efc_pos[equality]).max() < 1e-5
    # After a second with a force on the gripper, the arm held at home.
    data = made.build_start_data()
    data.ctrl[made.gripper.actuator] = -1.0
    for _ in range(2000):
        data.qpos[made.qpos], data.qvel[made.dof] = made.home, 0.0
        mujoco.mj_step(made.model, data)
    assert compute_deviation(made, data) < 1e-3


LOOP = '<connect name="loop_left"'
OFF = r"robot\.gripper: equality 'loop_left' is off by \d"


@pytest.mark.parametrize(
    ("weld", "words"),
    [('<weld name="loop_left"', OFF), ("<weld", "equality <weld> of 'rod_left' and 'tip_left' is")],
)
def test_a_linkage_that_cannot_move_is_refused(tmp_path: Path, weld: str, words: str) -> None:
    with pytest.raises(RobotError, match=words):
        build_linkage_cell(tmp_path, LOOP, weld)


FOLLOWERS = [("gear", "crank_right"), ("loop_right", "tip_right")]


@pytest.mark.parametrize(("equality", "joint"), FOLLOWERS)
def test_joint_that_follows_nothing_is_refused(tmp_path: Path, equality: str, joint: str) -> None:
    with pytest.raises(RobotError, match=rf"robot\.gripper: joint '{joint}' follows nothing"):
        build_linkage_cell(tmp_path, f'name="{equality}"', f'name="{equality}" active="false"')

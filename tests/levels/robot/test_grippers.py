"""Grippers as people's models have them: uncoupled fingers, soft couplings, light drives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from pydantic import ValidationError

from rack.backplane.message import State
from rack.levels.errors import RobotError
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.servo.control import Grip
from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig
from tests.levels.arms import CLOCK_NS, cell, config
from tests.levels.robot import grippers
from tests.levels.whole_rack import WholeRack

FOLLOW: dict[str, Any] = {"follow": [{"joint": "finger_right", "ratio": 1.0}]}
TRANSFER = {"do": "transfer", "object": "block1", "to": [0.50, -0.20, 0.475]}


Arm = tuple[RobotConfig, SceneConfig]


def close_gripper(arm: Arm, seconds: float) -> tuple[Cell, mujoco.MjData]:
    """Return the cell and its data after closing for some time, its loop at the clock's rate."""
    made = build_cell(*arm, CLOCK_NS)
    table = arm[0].gripper
    assert made.gripper is not None
    assert table is not None
    data = made.build_start_data()
    grip = Grip(table)
    grip._opening = table.closed
    for _ in range(round(seconds / (CLOCK_NS * 1e-9))):
        data.qpos[made.qpos], data.qvel[made.dof] = made.home, 0.0
        opening = data.qpos[made.gripper.linkage.driven]
        data.ctrl[made.gripper.actuator] = grip.compute_force(opening, data.qvel[made.gripper.dof])
        mujoco.mj_step(made.model, data, arm[0].substeps)
    return made, data


def test_a_finger_with_a_motor_that_nothing_commands_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="joint 'finger_right' has an actuator, 'grip_"):
        build_cell(*grippers.independent(tmp_path), CLOCK_NS)


def test_a_finger_that_follows_by_the_config_moves_with_the_driven_one(tmp_path: Path) -> None:
    made, data = close_gripper(grippers.independent(tmp_path, **FOLLOW), 0.5)
    assert [made.model.actuator(k).name for k in range(made.model.nu)][-1] == "grip"
    left, right = (data.joint(f"finger_{side}").qpos[0] for side in ("left", "right"))
    assert left < 0.02
    assert right == pytest.approx(left, abs=2e-4)


@pytest.mark.parametrize(
    ("joint", "words"),
    [
        ("thumb", "no joint 'thumb' in the model; it has: j1"),
        ("finger_left", "'finger_left' is the driven joint itself"),
    ],
)
def test_a_follower_that_cannot_follow_is_refused(tmp_path: Path, joint: str, words: str) -> None:
    with pytest.raises(RobotError, match=words):
        build_cell(*grippers.independent(tmp_path, follow=[{"joint": joint}]), CLOCK_NS)


def test_soft_couplings_are_posed_where_the_simulation_settles(tmp_path: Path) -> None:
    made, data = close_gripper(grippers.soft(tmp_path), 1.0)
    assert made.gripper is not None
    assert made.gripper.linkage.yields
    posed = np.array(data.qpos)
    made.gripper.linkage.set_opening(posed, float(data.qpos[made.gripper.linkage.driven]))
    tips = [int(made.model.joint(f"tip_{side}").qposadr[0]) for side in ("left", "right")]
    assert posed[tips] == pytest.approx(data.qpos[tips], abs=0.02)


def test_fingers_that_settle_away_from_their_planned_pose_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"a finger settles .* mm from .*residual permits 0\.0 mm"):
        build_cell(*grippers.soft(tmp_path, residual=1e-9), CLOCK_NS)
    with pytest.raises(RobotError, match=r"robot\.gripper\.force: 1e-06 does not move"):
        build_cell(*grippers.soft(tmp_path, force=1e-6, stiffness=20.0, damping=0.1), CLOCK_NS)
    with pytest.raises(ValidationError, match=r"both 0\.1: the gripper does not move"):
        GripperConfig(actuator="grip", joint="elbow", open=0.1, closed=0.1, force=1.0)


def test_a_light_drive_gets_the_inertia_that_its_loop_needs(tmp_path: Path) -> None:
    made, data = close_gripper(grippers.rotary(tmp_path, armature=""), 1.0)
    assert made.gripper is not None
    assert made.model.dof_armature[made.gripper.dof] > 0.0
    assert abs(data.qvel[made.gripper.dof]) < 0.01
    # Nothing is added to that of the PUMA.
    puma, table = cell("puma560"), config("puma560")[0].gripper
    assert puma.gripper is not None
    assert puma.model.dof_armature[puma.gripper.dof] == 0.1
    assert table is not None
    assert (table.gains, table.rest_threshold) == ((2000.0, 60.0), 0.002)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "kind", [grippers.independent, grippers.soft, grippers.one_finger, grippers.four_bar]
)
def test_a_transfer_is_done_with_every_kind_of_gripper(tmp_path: Path, kind: Any) -> None:
    arm = kind(tmp_path, **FOLLOW if kind is grippers.independent else {})
    rack = WholeRack(arm=arm, actions=[TRANSFER])
    status = rack.run_to_end(25.0)
    assert status.state == State.DONE, status.reason
    assert rack.read("servo.status").touches == 0
    assert rack.read("world.model").position[0] == pytest.approx(TRANSFER["to"], abs=0.01)

"""Grasps that lean, and arms of five joints, which reach most places in few orientations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.errors import Refused
from rack.levels.messages import Error
from rack.levels.planning.motion_planner import MotionPlanner
from rack.levels.robot.cell import build_cell
from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig
from rack.levels.task.actions import rehearse, rehearse_goto
from rack.levels.task.program import Goto, TaskConfig
from rack.levels.task.rehearsal import Rehearsal
from tests.levels.arms import CLOCK_NS, config, find_situation
from tests.levels.whole_rack import WholeRack

FIVE = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="table" type="box" size=".5 .5 .02" pos="0 0 -.02" friction="1"/>
    <body name="can" pos=".25 0 .05"><freejoint/>
      <geom name="can" type="cylinder" size=".014 .05" density="400" friction="1 .02 .001"
        condim="4" solimp=".95 .99 .001" solref=".004 1"/></body>
    <body name="turret" pos="0 0 .1">
      <joint name="turn" axis="0 0 1" range="-3 3" damping=".1"/>
      <geom type="cylinder" fromto="0 0 -.02 0 0 .02" size=".03"/>
      <body name="upper" pos="0 0 .04">
        <joint name="shoulder" axis="0 1 0" range="-2 2" damping=".1"/>
        <geom type="capsule" fromto="0 0 .05 0 0 .2" size=".02"/>
        <body name="fore" pos="0 0 .25">
          <joint name="elbow" axis="0 1 0" range="-2.7 2.7" damping=".1"/>
          <geom type="capsule" fromto="0 0 .05 0 0 .15" size=".018"/>
          <body name="wrist" pos="0 0 .2">
            <joint name="bend" axis="0 1 0" range="-{bend} {bend}" damping=".1"/>
            <geom type="capsule" fromto="0 0 0 0 0 .02" size=".015"/>
            <body name="palm" pos="0 0 .05">
              <joint name="roll" axis="0 0 1" range="-3 3" damping=".1"/>
              <geom name="palm" type="box" size=".012 .035 .01"/>
              <site name="tcp" pos="0 0 .07"/>
              <body name="left"><joint name="left" type="slide" axis="0 1 0" range="0 .025"
                damping="5" armature=".05"/>
                <geom name="left" type="box" size=".008 .004 .03" pos="0 .004 .06" friction="1"/>
              </body>
              <body name="right"><joint name="right" type="slide" axis="0 -1 0" range="0 .025"
                damping="5" armature=".05"/>
                <geom name="right" type="box" size=".008 .004 .03" pos="0 -.004 .06" friction="1"/>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="left" joint2="right" solref=".002 1"/></equality>
  <contact><exclude body1="turret" body2="upper"/><exclude body1="upper" body2="fore"/>
    <exclude body1="fore" body2="wrist"/><exclude body1="wrist" body2="palm"/>
    <exclude body1="world" body2="turret"/><exclude body1="fore" body2="palm"/></contact>
  <actuator><motor name="grip" joint="left" ctrlrange="-20 20"/></actuator>
</mujoco>
"""
SCENE = SceneConfig(objects=("can",), supports=("table",))


def write_five_joint_arm(folder: Path, bend: float = 2.0) -> RobotConfig:
    """Write an arm of five joints with a can on its table; return its config."""
    model = folder / "five.xml"
    model.write_text(FIVE.format(bend=bend))
    return RobotConfig(
        model=model,
        joints=("turn", "shoulder", "elbow", "bend", "roll"),
        tool="tcp",
        home=(0.0, -0.5, 1.6, 0.8, 0.0),
        velocity=(2.0,) * 5,
        acceleration=(6.0,) * 5,
        jerk=(60.0,) * 5,
        torque=(30.0, 30.0, 20.0, 10.0, 5.0),
        gripper=GripperConfig(actuator="grip", joint="left", open=0.025, closed=0.0, force=15.0),
    )


def rehearsal(robot: RobotConfig, scene: SceneConfig = SCENE) -> Rehearsal:
    made = build_cell(robot, scene, CLOCK_NS)
    return Rehearsal(MotionPlanner(made, scene, 1), made.home, find_situation(made))


def transfer(to: list[float]) -> dict[str, Any]:
    return {"do": "transfer", "object": "can", "to": to, "lift": 0.06}


@pytest.mark.slow
def test_a_refusal_says_when_another_orientation_would_reach(tmp_path: Path) -> None:
    start = rehearsal(write_five_joint_arm(tmp_path))
    with pytest.raises(Refused, match="in reach in another orientation"):
        rehearse_goto(start, 0, Goto(position=(0.45, 0.0, 0.25)))
    with pytest.raises(Refused) as refused:
        rehearse_goto(start, 0, Goto(position=(0.9, 0.0, 0.25)))
    assert "orientation" not in str(refused.value)


def test_a_goto_in_any_direction_reaches_the_place_with_five_joints(tmp_path: Path) -> None:
    start = rehearsal(write_five_joint_arm(tmp_path))
    place = (0.40, 0.1, 0.25)
    end = rehearse_goto(start, 0, Goto(position=place, direction="any"))
    assert end.motion.ik.compute_tool_pose(end.q).position == pytest.approx(place, abs=1e-4)
    with pytest.raises(Refused, match="out of reach"):
        rehearse_goto(start, 0, Goto(position=(0.9, 0.0, 0.2), direction="any"))


@pytest.mark.parametrize(
    ("bend", "lean"), [pytest.param(2.0, 0.0, marks=pytest.mark.slow), (0.9, np.pi / 18)]
)
def test_a_grasp_leans_where_it_must(tmp_path: Path, bend: float, lean: float) -> None:
    start = rehearsal(write_five_joint_arm(tmp_path, bend=bend))
    program = TaskConfig(action=[transfer([0.18, 0.15, 0.05])])
    moves = rehearse(program, SCENE, start).moves
    tool = next(move.tool for move, _ in moves if move.object is not None)
    down = np.zeros(3)
    mujoco.mju_rotVecQuat(down, np.array([0.0, 0.0, 1.0]), tool.quaternion)
    assert np.arccos(np.clip(-down[2], -1.0, 1.0)) == pytest.approx(lean, abs=1e-4)


@pytest.mark.thorough
def test_five_joints_transfer_a_can(tmp_path: Path) -> None:
    to = [0.18, 0.15, 0.05]
    rack = WholeRack(arm=(write_five_joint_arm(tmp_path, bend=0.9), SCENE), actions=[transfer(to)])
    status = rack.run_to_end(25.0)
    assert status.state == State.DONE, status.reason
    assert rack.read("servo.status").touches == 0
    assert rack.read("world.model").position[0] == pytest.approx(to, abs=0.01)


@pytest.mark.thorough
def test_a_place_behind_the_wall_is_refused_with_the_reason() -> None:
    robot, scene = config("puma560")
    action = {"do": "transfer", "object": "block1", "to": (0.62, 0.0, 0.475)}
    why = r"place block1 at \[0.62, 0, 0.475\]: 'forearm' and 'wall' are -\d+.\d mm apart"
    with pytest.raises(Refused, match=why) as refused:
        rehearse(TaskConfig(action=[action]), scene, rehearsal(robot, scene))
    assert refused.value.code == Error.NO_PATH

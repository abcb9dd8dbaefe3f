"""A cell: any arm, from its description alone; every mistake in it is reported in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from rack.levels.errors import RobotError
from rack.levels.robot.cell import Cell, build_cell, compute_sizes
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.limits import (
    MAX_PATIENCE_S,
    MIN_PATIENCE_CYCLES,
    PATIENCE_FRACTION,
    MotorPatience,
    compute_patience,
)
from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig
from tests.levels.arms import BLOCK, CLOCK_NS, MOTORS, cell, config, pendulum

EMPTY = SceneConfig()
POSITION = '<position joint="shoulder" kp="90" forcerange="-31 31"/>'


def build(robot: RobotConfig, scene: SceneConfig = EMPTY) -> Cell:
    return build_cell(robot, scene, CLOCK_NS)


@pytest.mark.parametrize("name", ["puma560", "puma560_crossing", "penn_cell", "k1607"])
def test_every_arm_of_the_project_builds_and_starts_at_home_without_a_touch(name: str) -> None:
    robot, scene = config(name)
    made = build(robot, scene)
    data = made.build_start_data()
    assert data.qpos[made.qpos] == pytest.approx(robot.home)
    assert compute_sizes(made)["joints"] == len(robot.joints)
    assert compute_sizes(made)["bodies"] == max(1, len(scene.bodies))
    assert made.model.opt.timestep == pytest.approx(CLOCK_NS * 1e-9 / robot.substeps)


@pytest.mark.parametrize("name", ["puma560", "k1607"])
def test_the_tool_points_down_at_home_away_from_singularities(name: str) -> None:
    made = cell(name)
    data = made.build_start_data()
    jacobian = np.zeros((6, made.model.nv))
    mujoco.mj_jacSite(made.model, data, jacobian[:3], jacobian[3:], made.tool)
    assert data.site_xmat[made.tool].reshape(3, 3)[:, 2] == pytest.approx([0, 0, -1], abs=1e-3)
    assert np.linalg.svd(jacobian[:, made.dof])[1][-1] > 0.15


def test_a_free_body_listed_before_the_arm_shifts_no_index(tmp_path: Path) -> None:
    scene = SceneConfig(objects=("block",), supports=("floor",))
    made = build(pendulum(tmp_path, first=BLOCK), scene)
    assert made.qpos.tolist() == [7, 8]
    assert made.dof.tolist() == [6, 7]
    assert made.object_qpos.tolist() == [0]
    assert made.build_start_data().qpos[made.qpos] == pytest.approx([0.0, 0.5])


@pytest.mark.parametrize(
    ("shoulder", "limit"),
    [
        ('<motor joint="shoulder" ctrlrange="-2 2" gear="15"/>', 30.0),
        ('<motor joint="shoulder" ctrlrange="-50 50" forcerange="-12 12" gear="2"/>', 24.0),
        (POSITION, 31.0),
        (POSITION + '<velocity joint="shoulder" kv="5"/>', 31.0),
        ('<intvelocity joint="shoulder" kp="90" actrange="-1 1" forcerange="-7 7"/>', 7.0),
        ('<general jointinparent="shoulder" gainprm="10" ctrlrange="-3 3"/>', 30.0),
    ],
)
def test_any_drive_becomes_a_torque_motor(tmp_path: Path, shoulder: str, limit: float) -> None:
    made = build(pendulum(tmp_path, shoulder + '<motor joint="elbow" ctrlrange="-20 20"/>'))
    assert made.model.nu == 2
    assert made.model.na == 0
    assert made.bounds.torque == pytest.approx([limit, 20.0])
    data = made.build_start_data()
    data.ctrl[made.actuators] = [1.5, -2.5]
    mujoco.mj_forward(made.model, data)
    assert data.qfrc_actuator[made.dof] == pytest.approx([1.5, -2.5])


def test_sensors_and_keyframes_of_replaced_actuators_are_removed(tmp_path: Path) -> None:
    robot = pendulum(tmp_path, MOTORS.replace("<motor", '<motor name="m"', 1))
    text = robot.model.read_text()
    keyframe, sensor = '<key ctrl="1 2"/>', '<actuatorfrc actuator="m"/>'
    extra = f"<keyframe>{keyframe}</keyframe><sensor>{sensor}</sensor></mujoco>"
    robot.model.write_text(text.replace("</mujoco>", extra))
    assert build(robot).model.nsensor == 0


def test_the_config_may_give_torques_ranges_armature_and_a_body_as_tool(tmp_path: Path) -> None:
    drives = '<motor joint="shoulder"/><position name="winch" tendon="cable" kp="10"/>'
    given = {"torque": (45.0, 10.0), "position": ((-1.0, 3.0), (-3.0, 1.0))}
    made = build(pendulum(tmp_path, drives, **given, min_armature=0.07, tool="lower"))
    assert made.model.nu == 2
    assert made.bounds.torque == pytest.approx([45.0, 10.0])
    # The tighter of two ranges holds, and the greater of two armatures.
    assert made.bounds.position.tolist() == [[-1.0, 2.0], [-2.0, 1.0]]
    assert made.model.dof_armature[made.dof] == pytest.approx([0.07, 0.07])
    assert cell("puma560").model.dof_armature[0] == pytest.approx(0.784029968642)
    data = made.build_start_data()
    assert data.site_xpos[made.tool] == pytest.approx(data.body("lower").xpos)


GRIPPER = {"actuator": "grip", "joint": "elbow", "open": 0.1, "closed": 0.0, "force": 5.0}
JOINT = '<body name="b" pos="2 0 1"><joint name="shoulder2" type="ball"/><geom size=".1"/></body>'
BALL = {"first": JOINT, "joints": ("shoulder2", "elbow")}
ONE, HAS = '<motor joint="shoulder"/>', "in the model; it has:"
FIELD = '<asset><hfield name="h" nrow="20000" ncol="20000" size="1 1 1 1"/></asset>'
OUTSIDE = "leaves the model's folder"
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "joint": ({"joints": ("shoulder", "wrist")}, f"no joint 'wrist' {HAS} shoulder, elbow"),
    "tool": ({"tool": "tcp"}, f"robot.tool: no site 'tcp' {HAS} tip"),
    "home outside": ({"home": (0.0, 2.5)}, "'elbow' is at 2.5 rad; it must be -1.995 to 1.995"),
    "home touches": ({"home": (1.5, 0.5)}, "'floor' touches 'lower'"),
    "too weak": ({"torque": (1.0, 20.0)}, "joint 'shoulder' needs"),
    "no range": (
        {"position": ((2.5, 3.0), (-1.0, 1.0))},
        "'shoulder' cannot move from 2.5 to 2 rad",
    ),
    "gripper": ({"gripper": GripperConfig(**GRIPPER)}, "'grip' is not in the model"),
    "object": ({"objects": "cup"}, f"no body 'cup' {HAS} world, block, upper, lower"),
    "not free": ({"objects": "lower"}, "body 'lower' has no free joint"),
    "obstacle": ({"obstacles": "block"}, "body 'block' is not a mocap body"),
    "support": ({"supports": "shelf"}, "no geom 'shelf' in the model"),
    "no support": ({"objects": "block"}, "'floor' touches 'block'"),
    "nan step": ({"timestep": "nan"}, "<option>: timestep = 'nan'; it must be finite numbers"),
    "no step": ({"timestep": "0"}, "timestep 0 s is invalid"),
    "long step": ({"timestep": "2.5"}, "2.5 s is invalid; it must be above 0 and at most 0.1"),
    "no limit": ({"actuators": ONE}, "joint 'shoulder': the model has no torque limit"),
    "ball": (BALL, "'shoulder2' is a ball joint, must be hinge or slide"),
    "malformed": ({"first": "<body>"}, "malformed XML"),
    "unknown": ({"first": "<chair/>"}, "unrecognized"),
    "huge": ({"first": f"</worldbody>{FIELD}<worldbody>"}, "nrow x ncol = 4e+08; at most 4000000"),
    "outside": ({"first": '<include file="/etc/hostname"/>'}, f"include '/etc/hostname' {OUTSIDE}"),
    "parent": ({"first": '<include file="../other.xml"/>'}, f"include '../other.xml' {OUTSIDE}"),
    "lost": ({"first": '<include file="other.xml"/>'}, "no such file"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_config_scene_or_model_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    changed, message = WRONG[case]
    scene = {key: (name,) for key, name in changed.items() if key in SceneConfig.model_fields}
    given = {"first": BLOCK} if scene else changed
    with pytest.raises(RobotError) as refused:
        build(pendulum(tmp_path, **given), SceneConfig(**scene))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


ROBOT, SCENE = config("puma560")


@pytest.mark.parametrize("arm", ["puma560", "k1607"])
def test_motors_add_at_most_a_fraction_of_the_energy_that_the_brakes_absorb(arm: str) -> None:
    made = cell(arm)
    speed, patience = made.bounds.velocity, made.patience
    kinetic = 0.5 * speed @ Dynamics(made).terms(made.home, 0.0 * speed).inertia @ speed
    # The fingers of `Dynamics` are open, those of the model at its reference.
    added = patience.seconds * (speed @ made.bounds.torque)
    assert added == pytest.approx(PATIENCE_FRACTION * kinetic, rel=0.01)
    way = 0.5 * speed**2 / config(arm)[0].acceleration
    assert (patience.seconds * speed <= PATIENCE_FRACTION * way).all()


def test_an_arm_with_weak_motors_is_bounded_by_the_angle_and_by_the_longest_time() -> None:
    bounds = cell("puma560").bounds
    hard = ROBOT.model_copy(update={"acceleration": (200.0,) * 6})
    seconds = compute_patience(hard, bounds, 1e6).seconds
    assert seconds == pytest.approx(PATIENCE_FRACTION * 0.5 * 1.51 / 200.0)
    longest = MotorPatience(MAX_PATIENCE_S, MIN_PATIENCE_CYCLES)
    assert compute_patience(ROBOT, bounds, 1e6) == longest
    # The PUMA: 5 ms at 400 Hz and at 1 kHz.
    patience = cell("puma560").patience
    rates = ((1, 0.0025), (1, 0.001), (5, 0.001))
    assert [patience.ticks(every, tick_s) for every, tick_s in rates] == [2, 5, 10]


@pytest.mark.parametrize(
    ("asked_ms", "ticks"), [(0.9, 1), (2.5, 1), (4.9, 1), (5.0, 2), (7.5, 3), (100.0, 40)]
)
def test_a_patience_that_is_set_is_in_whole_cycles(asked_ms: float, ticks: int) -> None:
    given = RobotConfig(**(dict(ROBOT) | {"patience_ms": asked_ms}))
    assert build_cell(given, SCENE, CLOCK_NS).patience.ticks(1, 0.0025) == ticks

"""A cell: any arm, from its description alone; every mistake in it is reported in one line."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from rack.levels.errors import RobotError
from rack.levels.robot.cell import Cell, build_cell, compute_sizes
from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig
from tests.levels.arms import BLOCK, CLOCK_NS, MOTORS, cell, config, pendulum

EMPTY = SceneConfig()


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
    made = build(
        pendulum(tmp_path, first=BLOCK), SceneConfig(objects=("block",), supports=("floor",))
    )
    assert made.qpos.tolist() == [7, 8]
    assert made.dof.tolist() == [6, 7]
    assert made.object_qpos.tolist() == [0]
    assert made.build_start_data().qpos[made.qpos] == pytest.approx([0.0, 0.5])


@pytest.mark.parametrize(
    ("shoulder", "limit"),
    [
        ('<motor joint="shoulder" ctrlrange="-2 2" gear="15"/>', 30.0),
        ('<motor joint="shoulder" ctrlrange="-50 50" forcerange="-12 12" gear="2"/>', 24.0),
        ('<position joint="shoulder" kp="90" forcerange="-31 31"/>', 31.0),
        (
            (
                '<position joint="shoulder" kp="90" forcerange="-31 31"/><velocity joint="shoulder"'
                ' kv="5"/>'
            ),
            31.0,
        ),
        ('<intvelocity joint="shoulder" kp="90" actrange="-1 1" forcerange="-7 7"/>', 7.0),
        ('<general jointinparent="shoulder" gainprm="10" ctrlrange="-3 3"/>', 30.0),
    ],
)
def test_any_drive_of_a_joint_becomes_a_torque_motor_with_its_limit(
    tmp_path: Path, shoulder: str, limit: float
) -> None:
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
    extra = (
        '<keyframe><key ctrl="1 2"/></keyframe><sensor><actuatorfrc'
        ' actuator="m"/></sensor></mujoco>'
    )
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


def gripper(**changed: str) -> GripperConfig:
    tables = {"actuator": "grip", "joint": "elbow", "open": 0.1, "closed": 0.0, "force": 5.0}
    return GripperConfig(**{**tables, **changed})


WRONG_CONFIGS = {
    "joint": (
        {"joints": ("shoulder", "wrist")},
        "no joint 'wrist' in the model; it has: shoulder, elbow",
    ),
    "tool": ({"tool": "tcp"}, "robot.tool: no site 'tcp' in the model; it has: tip"),
    "home outside": (
        {"home": (0.0, 2.5)},
        "joint 'elbow' is at 2.5 rad; it must be -1.995 to 1.995",
    ),
    "home touches": ({"home": (1.5, 0.5)}, "'floor' touches 'lower'"),
    "too weak": ({"torque": (1.0, 20.0)}, "joint 'shoulder' needs"),
    "no range": (
        {"position": ((2.5, 3.0), (-1.0, 1.0))},
        "joint 'shoulder' cannot move from 2.5 to 2 rad",
    ),
    "gripper": ({"gripper": gripper()}, "'grip' is not in the model"),
}


@pytest.mark.parametrize("case", WRONG_CONFIGS)
def test_a_config_that_does_not_fit_the_model_is_refused_in_one_line(
    tmp_path: Path, case: str
) -> None:
    changed, message = WRONG_CONFIGS[case]
    with pytest.raises(RobotError) as refused:
        build(pendulum(tmp_path, **changed))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


WRONG_SCENES = {
    "object": (
        SceneConfig(objects=("cup",)),
        "no body 'cup' in the model; it has: world, block, upper, lower",
    ),
    "not free": (SceneConfig(objects=("lower",)), "body 'lower' has no free joint"),
    "obstacle": (SceneConfig(obstacles=("block",)), "body 'block' is not a mocap body"),
    "support": (SceneConfig(supports=("shelf",)), "no geom 'shelf' in the model"),
    "no support": (SceneConfig(objects=("block",)), "'floor' touches 'block'"),
}


@pytest.mark.parametrize("case", WRONG_SCENES)
def test_a_scene_that_does_not_fit_the_model_is_refused_in_one_line(
    tmp_path: Path, case: str
) -> None:
    scene, message = WRONG_SCENES[case]
    with pytest.raises(RobotError) as refused:
        build(pendulum(tmp_path, first=BLOCK), scene)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


WRONG_MODELS = {
    "nan step": ({"timestep": "nan"}, "<option>: timestep = 'nan'; it must be finite numbers"),
    "no step": ({"timestep": "0"}, "timestep 0 s is invalid"),
    "long step": (
        {"timestep": "2.5"},
        "timestep 2.5 s is invalid; it must be above 0 and at most 0.1",
    ),
    "no limit": (
        {"actuators": '<motor joint="shoulder"/>'},
        "joint 'shoulder': the model has no torque limit",
    ),
    "ball": (
        {
            "first": (
                '<body name="b" pos="2 0 1"><joint name="shoulder2" type="ball"/><geom'
                ' size=".1"/></body>'
            )
        },
        "",
    ),
    "malformed": ({"first": "<body>"}, "malformed XML"),
    "unknown": ({"first": "<chair/>"}, "unrecognized"),
    "huge": (
        {
            "first": (
                '</worldbody><asset><hfield name="h" nrow="20000" ncol="20000" size="1 1 1'
                ' 1"/></asset><worldbody>'
            )
        },
        "nrow x ncol = 4e+08; at most 4000000",
    ),
    "outside": (
        {"first": '<include file="/etc/hostname"/>'},
        "include '/etc/hostname' leaves the model's folder",
    ),
    "parent": (
        {"first": '<include file="../other.xml"/>'},
        "include '../other.xml' leaves the model's folder",
    ),
    "lost": ({"first": '<include file="other.xml"/>'}, "no such file"),
}


@pytest.mark.parametrize("case", WRONG_MODELS)
def test_a_model_that_cannot_be_used_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    changed, message = WRONG_MODELS[case]
    joints = ("shoulder2", "elbow") if case == "ball" else ("shoulder", "elbow")
    with pytest.raises(RobotError) as refused:
        build(pendulum(tmp_path, **changed, joints=joints))
    assert (message or "'shoulder2' is a ball joint, must be hinge or slide") in str(refused.value)
    assert "\n" not in str(refused.value)

"""What a `[robot]` table may leave to its model: joints, tool, home."""

import mujoco
import numpy as np

from rack.levels.errors import RobotError
from rack.levels.robot.lookup import below, find
from rack.levels.robot.model import JOINT_DRIVES, check_number, compile_spec, load_spec
from rack.levels.tables import RobotConfig


def derived(robot: RobotConfig) -> RobotConfig:
    """Return the table with its joints, tool and home. Raises `RobotError`."""
    model = compile_spec(load_spec(robot.model), robot.model)
    joints = robot.joints or _driven(model, robot)
    if not joints:
        raise RobotError("robot.joints: none named, and none in the model has an actuator")
    check_number(joints)
    kind = mujoco.mjtObj.mjOBJ_JOINT
    ids = [find(model, kind, name, "robot.joints") for name in joints]
    start = model.key_qpos[0] if model.nkey else model.qpos0
    home = start[model.jnt_qposadr[ids]].tolist()
    last = int(model.jnt_bodyid[ids[-1]])
    carried = below(model, np.array([last]))
    sites = [model.site(k).name for k in np.flatnonzero(carried[model.site_bodyid])]
    named = [name for name in sites if name] or [model.body(last).name]
    found = {"joints": joints, "tool": robot.tool or named[-1], "home": robot.home or tuple(home)}
    return robot.model_copy(update=found)


def _driven(model: mujoco.MjModel, robot: RobotConfig) -> tuple[str, ...]:
    """Return the joints with an actuator, base to tool, but the gripper's."""
    of_joint = np.isin(model.actuator_trntype, JOINT_DRIVES)
    driven = np.unique(model.actuator_trnid[of_joint, 0])
    names = [str(model.joint(k).name) for k in driven]
    gripper = robot.gripper
    own = () if gripper is None else (gripper.joint, *(given.joint for given in gripper.follow))
    return tuple(name for name in names if name not in own)

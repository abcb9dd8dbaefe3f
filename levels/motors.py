"""Torque motors for an arm: whatever drives its joints in the model is replaced by one plain motor a joint."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.errors import RobotError
from rack.levels.robot import GripperConfig, RobotConfig

JOINT_DRIVES = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def fit_motors(spec: mujoco.MjSpec, robot: RobotConfig) -> tuple[list[str], NDArray[np.float64]]:
    """Replace the drives of the arm's joints in `spec`; return the motors' names and torque limits (joints,), N m.

    A limit comes from `robot.torque`, else it is the tightest of the joint's actuatorfrcrange and the ranges of its
    actuators. Raises `RobotError` when neither has one.
    """
    drives = [a for a in spec.actuators if drives_arm(spec, a, robot)]
    limits = np.array([torque_limit(spec, name, k, robot, drives) for k, name in enumerate(robot.joints)])
    remove(spec, drives)
    names = [f"torque of {joint}" for joint in robot.joints]
    for name, joint, limit in zip(names, robot.joints, limits, strict=True):
        drive = spec.joint(joint)
        drive.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        # With actgravcomp the motor would carry a torque that nobody commanded; a passive force is in the model's bias.
        drive.actgravcomp = False
        add_motor(spec, name, mujoco.mjtTrn.mjTRN_JOINT, joint, limit)
    return names, limits


def fit_gripper(spec: mujoco.MjSpec, gripper: GripperConfig) -> None:
    """Make the gripper's actuator a force motor on the joint or tendon that it drives, limited to `gripper.force`.

    Raises `RobotError` when the model has no such actuator, or it drives neither a joint nor a tendon.
    """
    old = spec.actuator(gripper.actuator)
    if old is None:
        have = listed([a.name for a in spec.actuators])
        raise RobotError(f"robot.gripper.actuator: '{gripper.actuator}' is not in the model; actuators: {have}")
    kind, target = old.trntype, old.target
    if kind not in (*JOINT_DRIVES, mujoco.mjtTrn.mjTRN_TENDON):
        raise RobotError(f"robot.gripper.actuator: '{gripper.actuator}' is a {kind.name}; valid: on a joint or tendon")
    remove(spec, [old])
    add_motor(spec, gripper.actuator, kind, target, gripper.force)


def listed(names: list[str], most: int = 24) -> str:
    """Return names for an error message: at most `most` of them."""
    named = [n for n in names if n]
    more = f" and {len(named) - most} more" if len(named) > most else ""
    return (", ".join(named[:most]) or "none") + more


def drives_arm(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator, robot: RobotConfig) -> bool:
    """Say whether an actuator drives a joint of the arm, by itself or through a fixed tendon."""
    if actuator.trntype in JOINT_DRIVES:
        return actuator.target in robot.joints
    tendon = spec.tendon(actuator.target) if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON else None
    if tendon is None:
        return False
    return any(w.type == mujoco.mjtWrap.mjWRAP_JOINT and w.target.name in robot.joints for w in tendon.path)


def torque_limit(
    spec: mujoco.MjSpec, joint: str, index: int, robot: RobotConfig, drives: list[mujoco.MjsActuator]
) -> float:
    """Return the torque limit of one joint, N m. Raises `RobotError` when there is none."""
    if robot.torque is not None:
        return robot.torque[index]
    own = spec.joint(joint)
    found = [reach(own.actfrclimited, own.actfrcrange)]
    found += [drive_limit(a) for a in drives if a.trntype in JOINT_DRIVES and a.target == joint]
    limit = min((x for x in found if x > 0), default=0.0)
    if not (limit > 0 and np.isfinite(limit)):
        raise RobotError(f"joint '{joint}': the model gives no torque limit; give robot.torque, N m, one value a joint")
    return limit


def drive_limit(actuator: mujoco.MjsActuator) -> float:
    """Return the torque limit that an actuator on a joint implies, N m; 0: none."""
    gear = abs(float(actuator.gear[0]))
    limits = [reach(actuator.forcelimited, actuator.forcerange) * gear]
    direct = actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
    if direct and actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED:
        limits.append(reach(actuator.ctrllimited, actuator.ctrlrange) * abs(float(actuator.gainprm[0])) * gear)
    return min((x for x in limits if x > 0), default=0.0)


def reach(limited: mujoco.mjtLimited, span: NDArray[np.float64]) -> float:
    """Return how far a range goes both ways; 0: there is no range."""
    if limited == mujoco.mjtLimited.mjLIMITED_FALSE or not span[0] < span[1]:
        return 0.0
    return max(0.0, min(-float(span[0]), float(span[1])))


def add_motor(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTrn, target: str, limit: float) -> None:
    """Add a motor of gear 1 whose control is its force, N or N m, within `limit` both ways."""
    motor = spec.add_actuator(name=name, trntype=kind, target=target)
    motor.set_to_motor()
    motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    motor.ctrlrange = motor.forcerange = [-limit, limit]


def remove(spec: mujoco.MjSpec, actuators: list[mujoco.MjsActuator]) -> None:
    """Remove actuators, and the sensors on them."""
    gone = {a.name for a in actuators}
    for sensor in list(spec.sensors):
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR and sensor.objname in gone:
            spec.delete(sensor)
    for actuator in actuators:
        spec.delete(actuator)

"""Reduces a gripper to one drive, which all its other joints follow."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, norm
from rack.levels.errors import RobotError
from rack.levels.robot.linkage import find_coupled_joints
from rack.levels.robot.lookup import list_geoms, mark_descendants
from rack.levels.robot.model import (
    add_motor,
    find_driven_joints,
    find_torque_limit,
    format_names,
    remove_actuators,
)
from rack.levels.tables import FollowConfig, GripperConfig
from rack.tools.robot.arm import ArmParts

MOTOR_NAME = "gripper"
"""Name of the motor of a gripper that has none."""
DEFAULT_FORCE_N = 20.0
"""Force at the fingers in N, for a gripper whose model states none."""
MAX_FORCE_N = 40.0
"""Upper bound for the force at the fingers beyond friction. More would push out a light block."""
MIN_LEVER_M = 0.02
"""Lower bound for the lever arm of a finger that turns."""
MIN_CLOSING_COSINE = 0.5
"""Minimum cosine between the motion of a closing finger and the direction to the others."""


class _Finger(NamedTuple):
    """One joint of a gripper, with its open and its closed position in m or rad."""

    open: float
    closed: float
    lever: float  # m; 1 for a slide
    sideways: bool  # True if it spreads the fingers instead of closing them


def fit_gripper(
    spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmParts, wanted: str
) -> tuple[GripperConfig, str]:
    """Equip a gripper with a single drive. Joints that are not coupled to it become followers.

    Args:
        spec: The model. Surplus actuators are removed, and a missing one is added.
        model: The same model, compiled.
        arm: The arm that carries the gripper.
        wanted: Joint to be driven. Empty to prefer one with an actuator that closes the fingers.

    Returns:
        The gripper's table, and a text that lists the guesses in it.

    Raises:
        RobotError: A joint of the gripper has no range.
    """
    fingers = {name: _measure_finger(spec, model, arm, name) for name in arm.fingers}
    drives = [
        (actuator, driven_fingers[0])
        for actuator in spec.actuators
        if (
            driven_fingers := [
                joint for joint in find_driven_joints(spec, actuator) if joint in fingers
            ]
        )
    ]
    drives.sort(key=lambda drive: (drive[1] != wanted, fingers[drive[1]].sideways))
    driven = drives[0][1] if drives else wanted or arm.fingers[0]
    driven_finger = fingers[driven]
    preferred = [joint for _, joint in drives] + list(arm.fingers)
    groups = [group for group in _group_coupled_joints(model, arm) if driven not in group]
    leaders = [min(group, key=preferred.index) for group in groups]
    follow = tuple(
        FollowConfig(
            joint=name, ratio=_compute_ratio(model, (driven, driven_finger), (name, fingers[name]))
        )
        for name in leaders
        if name in preferred[: len(drives)] or not model.jnt_stiffness[model.joint(name).id]
    )
    # The single drive exerts the sum of the forces of all drives that it replaces.
    moving_joints = [driven, *(follower.joint for follower in follow if follower.ratio)]
    actuators = [actuator for actuator, _ in drives]
    stated = [find_torque_limit(spec, name, actuators) for name in moving_joints]
    levers = [fingers[name].lever for name in moving_joints]
    dry_friction = model.dof_frictionloss[
        [model.joint(name).dofadr[0] for name in moving_joints]
    ].tolist()
    forces = [
        min(stated_force or DEFAULT_FORCE_N * lever + friction, MAX_FORCE_N * lever + friction)
        for stated_force, lever, friction in zip(stated, levers, dry_friction, strict=True)
    ]
    force = sum(forces)
    remove_actuators(spec, actuators[1:])
    if drives:
        motor = actuators[0].name
    else:
        motor = MOTOR_NAME
        add_motor(spec, MOTOR_NAME, mujoco.mjtTrn.mjTRN_JOINT, driven, force)
    config = GripperConfig(
        actuator=motor,
        joint=driven,
        open=round(driven_finger.open, 5),
        closed=round(driven_finger.closed, 5),
        force=round(force, 3),
        follow=follow,
    )
    guesses = [] if forces == stated else ["force"]
    guesses += (
        [f"that {format_names([follower.joint for follower in follow])} follow"] if follow else []
    )
    return config, ", ".join(guesses)


def _measure_finger(
    spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmParts, name: str
) -> _Finger:
    """Measure one joint of a gripper.

    The closed end is the one nearer to the middle of all fingers, or to the hand for a single
    finger. Raises `RobotError` for a joint without a range.
    """
    joint = model.joint(name).id
    low, high = model.jnt_range[joint]
    if not model.jnt_limited[joint]:
        raise RobotError(f"joint '{name}' of the gripper has no range")
    for actuator in spec.actuators:
        # The set points of a servo may cover only a part of the joint's range.
        if actuator.target == name and actuator.biastype and np.ptp(actuator.ctrlrange) > 0.0:
            low, high = np.clip(actuator.ctrlrange, low, high)
    data = mujoco.MjData(model)
    ids = [model.joint(finger).id for finger in arm.fingers]
    data.qpos[model.jnt_qposadr[ids]] = model.jnt_range[ids].mean(axis=1)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    hand = model.body(arm.tip).id
    bodies = {int(model.jnt_bodyid[k]) for k in ids}
    depth = np.sum([mark_descendants(model, np.array([body])) for body in bodies], axis=0)
    tops = [body for body in bodies if depth[body] == 1]
    centres = [_compute_centre(model, data, body) for body in tops]
    middle = np.mean(centres, axis=0) if len(tops) > 1 else _compute_centre(model, data, hand)
    moved = int(model.jnt_bodyid[joint])
    centre = _compute_centre(model, data, moved)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, centre, moved)
    motion = jacobian[:, model.jnt_dofadr[joint]]
    inward = float(motion @ (middle - centre))
    is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    lever = 1.0 if is_slide else max(MIN_LEVER_M, norm(centre - data.xanchor[joint]))
    sideways = abs(inward) < MIN_CLOSING_COSINE * norm(motion) * norm(middle - centre)
    ends = (low, high) if inward > 0.0 else (high, low)
    return _Finger(*ends, lever, sideways)


def _compute_centre(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Array:
    """Compute the mean position of the geoms of a body and all bodies on it, (3,), in m."""
    geoms = list_geoms(model, mark_descendants(model, np.array([body])))
    if not len(geoms):
        return np.asarray(data.xipos[body])
    return np.asarray(data.geom_xpos[geoms].mean(axis=0))


def _group_coupled_joints(model: mujoco.MjModel, arm: ArmParts) -> list[set[str]]:
    """Group the joints of the gripper, so that joints coupled by equalities are in one group."""
    groups = [{name} for name in arm.fingers]
    for equality in range(model.neq):
        tied = {model.joint(joint).name for joint in find_coupled_joints(model, equality)} & {
            *arm.fingers
        }
        together = [group for group in groups if group & tied]
        groups = [group for group in groups if not group & tied]
        if together:
            groups.append(set.union(*together))
    return groups


def _compute_ratio(
    model: mujoco.MjModel, leader: tuple[str, _Finger], follower: tuple[str, _Finger]
) -> float:
    """Compute the motion of a follower per unit of motion of the driven joint.

    Joints of the same kind move equally far. Otherwise the full range of the one corresponds to the
    full range of the other. The ratio is 0 for a follower that does not close the fingers.
    """
    (driven, leader_finger), (name, finger) = leader, follower
    if finger.sideways:
        return 0.0
    ratio = (finger.closed - finger.open) / (leader_finger.closed - leader_finger.open)
    is_same = model.joint(driven).type == model.joint(name).type
    return float(np.sign(ratio)) if is_same else round(ratio, 5)

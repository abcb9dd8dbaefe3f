"""The gripper that an arm carries: one joint drives it, the others follow."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, norm
from rack.levels.errors import RobotError
from rack.levels.robot.linkage import tied_joints
from rack.levels.robot.lookup import below, geoms_of
from rack.levels.robot.model import add_motor, driven_by, listed, remove, stated_torque
from rack.levels.tables import FollowConfig, GripperConfig
from rack.tools.robot.arm import ArmParts

MOTOR = "gripper"
"""Name of the motor of a gripper that has none."""
FORCE_N = 20.0
"""Of a gripper whose model says nothing, at its fingers."""
MOST_FORCE_N = 40.0
"""At the fingers, beyond their dry friction; of more, which pushes a light block out, no use is
made."""
LEAST_LEVER_M = 0.02
SIDEWAYS = 0.5
"""Cosine between a finger's motion and the way to the others below which it does not close."""


class _Finger(NamedTuple):
    open: float
    closed: float
    lever: float  # m; 1 for a slide
    sideways: bool  # spreads the fingers, rather than closes them


def fit_fingers(
    spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmParts, wanted: str
) -> tuple[GripperConfig, str]:
    """Give the gripper one drive, at the joint `wanted` if that is named, which all that nothing
    couples to it follows; return its table, and what of it is guessed. Raises `RobotError`.
    """
    fingers = {name: _finger(spec, model, arm, name) for name in arm.fingers}
    drives = [
        (actuator, found[0])
        for actuator in spec.actuators
        if (found := [joint for joint in driven_by(spec, actuator) if joint in fingers])
    ]
    drives.sort(key=lambda drive: (drive[1] != wanted, fingers[drive[1]].sideways))
    driven = drives[0][1] if drives else wanted or arm.fingers[0]
    own = fingers[driven]
    first = [joint for _, joint in drives] + list(arm.fingers)
    groups = [group for group in _groups(model, arm) if driven not in group]
    leaders = [min(group, key=first.index) for group in groups]
    follow = tuple(
        FollowConfig(joint=name, ratio=_ratio(model, (driven, own), (name, fingers[name])))
        for name in leaders
        if name in first[: len(drives)] or not model.jnt_stiffness[model.joint(name).id]
    )
    # One drive gives what all those gave that it stands for.
    moving = [driven, *(one.joint for one in follow if one.ratio)]
    actuators = [actuator for actuator, _ in drives]
    stated = [stated_torque(spec, name, actuators) for name in moving]
    levers = [fingers[name].lever for name in moving]
    dry = model.dof_frictionloss[[model.joint(name).dofadr[0] for name in moving]].tolist()
    used = [
        min(known or FORCE_N * lever + rub, MOST_FORCE_N * lever + rub)
        for known, lever, rub in zip(stated, levers, dry, strict=True)
    ]
    force = sum(used)
    remove(spec, actuators[1:])
    if drives:
        motor = actuators[0].name
    else:
        motor = MOTOR
        add_motor(spec, MOTOR, mujoco.mjtTrn.mjTRN_JOINT, driven, force)
    config = GripperConfig(
        actuator=motor,
        joint=driven,
        open=round(own.open, 5),
        closed=round(own.closed, 5),
        force=round(force, 3),
        follow=follow,
    )
    guesses = [] if used == stated else ["force"]
    guesses += [f"that {listed([one.joint for one in follow])} follow"] if follow else []
    return config, ", ".join(guesses)


def _finger(spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmParts, name: str) -> _Finger:
    """Return the ends of a joint of the gripper: it closes where it moves to the middle of all
    fingers, or to the hand. Raises `RobotError`.
    """
    joint = model.joint(name).id
    low, high = model.jnt_range[joint]
    if not model.jnt_limited[joint]:
        raise RobotError(f"joint '{name}' of the gripper has no range")
    for actuator in spec.actuators:
        # The set points of a servo may leave a part of the range out.
        if actuator.target == name and actuator.biastype and np.ptp(actuator.ctrlrange) > 0.0:
            low, high = np.clip(actuator.ctrlrange, low, high)
    data = mujoco.MjData(model)
    ids = [model.joint(finger).id for finger in arm.fingers]
    data.qpos[model.jnt_qposadr[ids]] = model.jnt_range[ids].mean(axis=1)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    hand = model.body(arm.tip).id
    bodies = {int(model.jnt_bodyid[k]) for k in ids}
    depth = np.sum([below(model, np.array([body])) for body in bodies], axis=0)
    tops = [body for body in bodies if depth[body] == 1]
    centres = [_centre(model, data, body) for body in tops]
    middle = np.mean(centres, axis=0) if len(tops) > 1 else _centre(model, data, hand)
    moved = int(model.jnt_bodyid[joint])
    centre = _centre(model, data, moved)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, centre, moved)
    motion = jacobian[:, model.jnt_dofadr[joint]]
    inward = float(motion @ (middle - centre))
    is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    lever = 1.0 if is_slide else max(LEAST_LEVER_M, norm(centre - data.xanchor[joint]))
    sideways = abs(inward) < SIDEWAYS * norm(motion) * norm(middle - centre)
    if inward > 0.0:
        return _Finger(low, high, lever, sideways)
    return _Finger(high, low, lever, sideways)


def _centre(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Array:
    geoms = geoms_of(model, below(model, np.array([body])))
    if not len(geoms):
        return np.asarray(data.xipos[body])
    return np.asarray(data.geom_xpos[geoms].mean(axis=0))


def _groups(model: mujoco.MjModel, arm: ArmParts) -> list[set[str]]:
    """Return the joints of the gripper, those together that equalities tie to each other."""
    groups = [{name} for name in arm.fingers]
    for equality in range(model.neq):
        tied = {model.joint(joint).name for joint in tied_joints(model, equality)} & {*arm.fingers}
        together = [group for group in groups if group & tied]
        groups = [group for group in groups if not group & tied]
        if together:
            groups.append(set.union(*together))
    return groups


def _ratio(
    model: mujoco.MjModel, leader: tuple[str, _Finger], follower: tuple[str, _Finger]
) -> float:
    """Return the ratio by which a joint closes as the driven one does: as far, if it is of the
    same kind, else in its range; 0 if it does not close.
    """
    (driven, lead), (name, own) = leader, follower
    if own.sideways:
        return 0.0
    ratio = (own.closed - own.open) / (lead.closed - lead.open)
    is_same = model.joint(driven).type == model.joint(name).type
    return float(np.sign(ratio)) if is_same else round(ratio, 5)

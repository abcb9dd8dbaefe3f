"""Finds the arm in a model: its joints from base to tool, and what it carries.

All other parts of the model are held in place.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from rack.levels.algebra import Mask
from rack.levels.errors import RobotError
from rack.levels.robot.hand import compute_moments
from rack.levels.robot.linkage import find_coupled_joints
from rack.levels.robot.lookup import find_element, mark_descendants
from rack.levels.robot.model import SCALAR_JOINTS, check_joint_count, format_names

GRIPPER_NAMES = re.compile("finger|grip|jaw|claw|knuckle|thumb", re.IGNORECASE)
"""Joints with such names belong to a gripper."""
MIN_ARM_JOINTS = 4
"""Number of joints in a row that make a branch an arm."""
MAX_FINGER_JOINTS = 4
"""Branches of about equal length with at most this many joints are the fingers of a hand."""
MIN_BASE_JOINTS = 3
"""Least number of joints before a branch for it to be a hand."""


@dataclass(frozen=True)
class ArmParts:
    """An arm, given by the names of its parts."""

    joints: tuple[str, ...]  # base to tool
    tip: str  # the body at its end, which carries the gripper
    fingers: tuple[str, ...]  # joints beyond the tip
    passive: tuple[str, ...]  # joints beyond the tip that nothing drives
    others: tuple[str, ...]  # tips of other arms


def find_arm(model: mujoco.MjModel, tip: str, joints: Sequence[str]) -> ArmParts:
    """Find an arm by its tip or its joints, or else the longest arm of the model.

    Args:
        model: The compiled model.
        tip: Body or site at the end of the arm. Empty to choose the arm by `joints`.
        joints: Joints of the arm, base to tool. Empty for all joints between base and tip.

    Raises:
        RobotError: A name is unknown, the model has no arm, or some joints have no drive.
    """
    driven = find_driven_joints(model)
    scalar = np.isin(model.jnt_type, SCALAR_JOINTS)
    others: list[int] = []
    if joints:
        ids = [find_element(model, mujoco.mjtObj.mjOBJ_JOINT, name, "--joints") for name in joints]
        end = int(model.jnt_bodyid[ids[-1]])
    elif tip:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
        body = mujoco.mjtObj.mjOBJ_BODY
        end = int(model.site_bodyid[site]) if site >= 0 else find_element(model, body, tip, "--tip")
    else:
        end, others = _find_longest_arm(model, scalar, driven)
    if not joints:
        moving = np.flatnonzero(scalar).tolist()
        chain = [k for k in moving if mark_descendants(model, model.jnt_bodyid[[k]])[end]]
        cut = next((k for k in chain[1:] if GRIPPER_NAMES.search(_joint_name(model, k))), None)
        if cut is not None:
            end = int(model.body_parentid[model.jnt_bodyid[cut]])
            chain = chain[: chain.index(cut)]
        # If no joint of the chain is driven, --torque states the limits of all of them.
        driven_in_chain = driven & {*chain} or {*chain}
        # Joints of a mobile base do not belong to the arm: skip passive joints and endless slides.
        while chain and (chain[0] not in driven_in_chain or _is_endless(model, chain[0])):
            chain = chain[1:]
        joints = [_joint_name(model, joint) for joint in chain]
        if passive := [
            _joint_name(model, joint) for joint in chain if joint not in driven_in_chain
        ]:
            raise RobotError(
                f"nothing drives {format_names(passive)}, though other joints of the arm "
                "have an actuator"
                " or an effort; --tip names a body before them, --joints what to drive"
            )
    if not joints:
        raise RobotError("no arm: no hinge or slide joints in a row; --tip names a body at its end")
    check_joint_count(joints)
    beyond = np.flatnonzero(
        scalar & mark_descendants(model, np.array([end]))[model.jnt_bodyid]
    ).tolist()
    beyond = [joint for joint in beyond if _joint_name(model, joint) not in joints]
    names = tuple(_joint_name(model, joint) for joint in beyond)
    has_gripper = not driven or driven & {*beyond} or any(map(GRIPPER_NAMES.search, names))
    return ArmParts(
        tuple(joints),
        model.body(end).name,
        names if has_gripper else (),
        () if has_gripper else names,
        tuple(model.body(other).name for other in others),
    )


def find_driven_joints(model: mujoco.MjModel) -> set[int]:
    """Return the ids of all joints that the model drives.

    A joint is driven by an actuator, directly or through a tendon, by the effort limit of a URDF,
    or through a coupling to other joints.
    """
    every = np.arange(model.njnt)
    drives = compute_moments(model, every, model.qpos0[model.jnt_qposadr]).any(axis=0)
    driven = every[drives | model.jnt_actfrclimited]
    return set(driven.tolist()).union(*(find_coupled_joints(model, k) for k in range(model.neq)))


def fix_joints(spec: mujoco.MjSpec, moving_joints: Iterable[str]) -> list[str]:
    """Fix all joints of a model except `moving_joints`, and remove free bodies and keyframes.

    Bodies moved from outside (mocap) and everything that refers to a removed element are removed as
    well.

    Args:
        spec: The model, which is changed.
        moving_joints: Names of the joints that remain movable.

    Returns:
        Names of the removed bodies.
    """
    moving = {*moving_joints}
    free_bodies = []
    bodies = list(spec.worldbody.bodies)
    # MuJoCo deletes what refers to a body or its contents together with the body, but not what
    # refers to a single joint. Replace each joint to be fixed by one of the same name in this body.
    fixed = spec.worldbody.add_body()
    for body in bodies:
        is_free = any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)
        if (is_free or body.mocap) and moving.isdisjoint(j.name for j in body.find_all("joint")):
            free_bodies.append(body.name)
            spec.delete(body)
            continue
        for joint in body.joints:
            if (name := joint.name) not in moving:
                spec.delete(joint)
                fixed.add_joint(name=name)
        bodies += body.bodies
    spec.delete(fixed)
    # Cameras and lights whose target was deleted remain, and are invalid.
    remaining = {"", *(body.name for body in spec.bodies)}
    aimed = [each for each in [*spec.cameras, *spec.lights] if each.targetbody not in remaining]
    for element in [*aimed, *spec.keys]:
        spec.delete(element)
    return free_bodies


def _find_longest_arm(
    model: mujoco.MjModel, scalar: Mask, driven: set[int]
) -> tuple[int, list[int]]:
    """Find the longest arm: the chain with the most joints, ending at a driven one if possible.

    Args:
        model: The compiled model.
        scalar: (joints,), True for hinges and slides.
        driven: Ids of the joints with a drive.

    Returns:
        The body at its end, and the bodies at which other arms begin.
    """
    joint_count = np.bincount(model.jnt_bodyid[scalar], minlength=model.nbody)
    depth = joint_count.copy()
    is_driven = np.full(model.nbody, not driven)
    is_driven[model.jnt_bodyid[[*driven]]] = True
    for body in range(model.nbody - 1, 0, -1):
        parent = model.body_parentid[body]
        is_driven[parent] |= is_driven[body]
        depth[body] *= is_driven[body]
        depth[parent] = max(depth[parent], joint_count[parent] + depth[body])
    body = 0
    passed_joints = 0
    others: list[int] = []
    while True:
        passed_joints += joint_count[body]
        children = np.flatnonzero(model.body_parentid == body)
        branches = [int(k) for k in children if k and depth[k]]
        branches.sort(key=lambda k: -depth[k])
        if not branches:
            return body, others
        longest = depth[branches[0]]
        is_even = len(branches) > 1 and depth[branches[1]] >= longest - 1
        if is_even and passed_joints >= MIN_BASE_JOINTS and longest <= MAX_FINGER_JOINTS:
            return body, others
        others += [k for k in branches[1:] if depth[k] >= MIN_ARM_JOINTS]
        body = branches[0]


def _is_endless(model: mujoco.MjModel, joint: int) -> bool:
    """Return True if a joint is a slide without limits."""
    return bool(model.jnt_type[joint] == SCALAR_JOINTS[1] and not model.jnt_limited[joint])


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return the name of a joint, given its id."""
    return str(model.joint(joint).name)

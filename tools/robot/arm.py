"""The arm in a model: its joints from base to tool, and what it carries; all else is held."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from rack.levels.algebra import Mask
from rack.levels.errors import RobotError
from rack.levels.robot.hand import actuator_moments
from rack.levels.robot.linkage import tied_joints
from rack.levels.robot.lookup import below, find
from rack.levels.robot.model import SCALAR_JOINTS, check_number, listed

OF_GRIPPER = re.compile("finger|grip|jaw|claw|knuckle|thumb", re.IGNORECASE)
"""In the name of a joint: it belongs to a gripper."""
LEAST_JOINTS = 4
"""Joints in a row that make a branch an arm."""
MOST_IN_FINGER = 4
"""Where branches of at most so many joints begin, of about equal length, there is a hand."""
BASE_JOINTS = 3
"""Joints before a branch, at least, for that."""


REFERRING = ("tendon", "equality", "actuator", "contact", "deformable", "sensor", "custom")
"""Sections of an MJCF file that refer to others."""
KINDS = {"jointinparent": "joint", "node": "body", "subtree": "body", "target": "body"}
KINDS |= {"xbody": "body", "refsite": "site", "sidesite": "site"}
KINDS |= {"cranksite": "site", "slidersite": "site"}
"""To what an attribute refers, where its name, but for a number, is not that of the kind."""


@dataclass(frozen=True)
class ArmParts:
    """An arm by the names of its parts."""

    joints: tuple[str, ...]  # base to tool
    tip: str  # the body at its end, which carries the gripper
    fingers: tuple[str, ...]  # joints beyond
    passive: tuple[str, ...]  # joints beyond that nothing drives
    others: tuple[str, ...]  # tips of other arms


def find_arm(model: mujoco.MjModel, tip: str, joints: Sequence[str]) -> ArmParts:
    """Return the arm that ends at the body or site `tip`, or has these `joints`; of neither is
    told, the longest. Raises `RobotError`.
    """
    driven = driven_joints(model)
    scalar = np.isin(model.jnt_type, SCALAR_JOINTS)
    others: list[int] = []
    if joints:
        ids = [find(model, mujoco.mjtObj.mjOBJ_JOINT, name, "--joints") for name in joints]
        end = int(model.jnt_bodyid[ids[-1]])
    elif tip:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
        body = mujoco.mjtObj.mjOBJ_BODY
        end = int(model.site_bodyid[site]) if site >= 0 else find(model, body, tip, "--tip")
    else:
        end, others = _longest(model, scalar, driven)
    if not joints:
        moving = np.flatnonzero(scalar).tolist()
        chain = [k for k in moving if below(model, model.jnt_bodyid[[k]])[end]]
        cut = next((k for k in chain[1:] if OF_GRIPPER.search(_name(model, k))), None)
        if cut is not None:
            end = int(model.body_parentid[model.jnt_bodyid[cut]])
            chain = chain[: chain.index(cut)]
        # Where no joint of the chain is driven, --torque states the limits of all.
        drives = driven & {*chain} or {*chain}
        # A mobile base stands: passive joints, and slides without an end.
        while chain and (chain[0] not in drives or _is_endless(model, chain[0])):
            chain = chain[1:]
        joints = [_name(model, joint) for joint in chain]
        if passive := [_name(model, joint) for joint in chain if joint not in drives]:
            raise RobotError(
                f"nothing drives {listed(passive)}, though other joints of the arm have an actuator"
                " or an effort; --tip names a body before them, --joints what to drive"
            )
    if not joints:
        raise RobotError("no arm: no hinge or slide joints in a row; --tip names a body at its end")
    check_number(joints)
    beyond = np.flatnonzero(scalar & below(model, np.array([end]))[model.jnt_bodyid]).tolist()
    beyond = [joint for joint in beyond if _name(model, joint) not in joints]
    names = tuple(_name(model, joint) for joint in beyond)
    has_gripper = not driven or driven & {*beyond} or any(map(OF_GRIPPER.search, names))
    return ArmParts(
        tuple(joints),
        model.body(end).name,
        names if has_gripper else (),
        () if has_gripper else names,
        tuple(model.body(other).name for other in others),
    )


def driven_joints(model: mujoco.MjModel) -> set[int]:
    """Return the joints for which a model states a drive: an actuator, by itself or through a
    tendon, the effort of a URDF, or a coupling to other joints.
    """
    every = np.arange(model.njnt)
    drives = actuator_moments(model, every, model.qpos0[model.jnt_qposadr]).any(axis=0)
    own = every[drives | model.jnt_actfrclimited]
    return set(own.tolist()).union(*(tied_joints(model, k) for k in range(model.neq)))


def hold(path: Path, kept: Iterable[str]) -> list[str]:
    """Take out of an MJCF file, as MuJoCo writes it, all joints but those `kept`, bodies that fly
    or that something outside moves, and what refers to them; return those bodies.
    """
    tree = ElementTree.parse(path)
    root = tree.getroot()
    moving = {("joint", name) for name in kept}
    gone = set[tuple[str, str]]()
    flying = []
    world = root.find("worldbody")
    assert world is not None, "MuJoCo writes one"
    parts = [part for part in world.iter() if part.tag in ("worldbody", "body", "frame")]
    for part in parts:
        for body in part.findall("body"):
            own = {(inner.tag, inner.get("name", "")) for inner in body.iter()}
            flies = (
                body.find("freejoint") is not None or body.find("joint[@type='free']") is not None
            )
            if not own & moving and (flies or "mocap" in body.attrib):
                part.remove(body)
                gone |= own
                flying.append(body.get("name", ""))
        for joint in [*part.findall("joint"), *part.findall("freejoint")]:
            if ("joint", joint.get("name", "")) not in moving:
                part.remove(joint)
                gone.add(("joint", joint.get("name", "")))
    for keys in root.findall("keyframe"):
        root.remove(keys)
    sections = [section for section in root if section.tag in REFERRING]
    # What refers to an element that is taken out may be referred to itself.
    while dropped := [
        (section, element)
        for section in parts + sections
        for element in section
        if (section in sections or element.tag in ("camera", "light")) and _refers(element, gone)
    ]:
        for section, element in dropped:
            section.remove(element)
            is_mixed = section in parts or section.tag in ("custom", "deformable")
            gone.add((element.tag if is_mixed else section.tag, element.get("name", "")))
    tree.write(path)
    return flying


def _refers(element: ElementTree.Element, gone: set[tuple[str, str]]) -> bool:
    """Return whether an element, or one in it, refers to one that is gone."""
    for inner in element.iter():
        for key, value in inner.items():
            is_typed = key in ("objname", "refname")
            kind = (inner.get(f"{key[:3]}type", "") if is_typed else key).rstrip("12")
            names = value.split() if inner.tag == "flex" else [value]
            if any((KINDS.get(kind, kind), name) in gone for name in names):
                return True
    return False


def _longest(model: mujoco.MjModel, scalar: Mask, driven: set[int]) -> tuple[int, list[int]]:
    """Find the longest arm: the way with the most joints that ends at a driven one, if any is.

    Args:
        model: The compiled model.
        scalar: (joints,), True for hinges and slides.
        driven: Joints with a drive.

    Returns:
        The body at its end, and the bodies where other arms begin.
    """
    own = np.bincount(model.jnt_bodyid[scalar], minlength=model.nbody)
    depth = own.copy()
    leads = np.full(model.nbody, not driven)
    leads[model.jnt_bodyid[[*driven]]] = True
    for body in range(model.nbody - 1, 0, -1):
        parent = model.body_parentid[body]
        leads[parent] |= leads[body]
        depth[body] *= leads[body]
        depth[parent] = max(depth[parent], own[parent] + depth[body])
    body = 0
    passed = 0
    others: list[int] = []
    while True:
        passed += own[body]
        children = np.flatnonzero(model.body_parentid == body)
        ways = [int(k) for k in children if k and depth[k]]
        ways.sort(key=lambda k: -depth[k])
        if not ways:
            return body, others
        longest = depth[ways[0]]
        is_even = len(ways) > 1 and depth[ways[1]] >= longest - 1
        if is_even and passed >= BASE_JOINTS and longest <= MOST_IN_FINGER:
            return body, others
        others += [k for k in ways[1:] if depth[k] >= LEAST_JOINTS]
        body = ways[0]


def _is_endless(model: mujoco.MjModel, joint: int) -> bool:
    return bool(model.jnt_type[joint] == SCALAR_JOINTS[1] and not model.jnt_limited[joint])


def _name(model: mujoco.MjModel, joint: int) -> str:
    return str(model.joint(joint).name)

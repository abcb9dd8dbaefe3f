"""The arm in a model: its joints from base to tool, and what it carries; all else is held."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from rack.levels.errors import RobotError
from rack.levels.robot.lookup import below
from rack.levels.robot.model import SCALAR_JOINTS, listed

OF_GRIPPER = re.compile("finger|grip|jaw|claw|knuckle|thumb", re.IGNORECASE)
"""In the name of a joint: it belongs to a gripper."""
LEAST_JOINTS = 4
"""Joints in a row that make a branch an arm."""
MOST_IN_FINGER = 4
"""Where branches of at most so many joints begin, of about equal length, there is a hand."""
BASE_JOINTS = 3
"""Joints before a branch, at least, for that."""


REFERRING = ("tendon", "equality", "actuator", "contact", "sensor")
"""Sections of an MJCF file that refer to others, in such an order."""
KINDS = {
    "target": "body",
    "jointinparent": "joint",
    **{f"{kind}{k}": kind for kind in ("joint", "body", "site", "tendon", "geom") for k in (1, 2)},
}
"""To what an attribute refers, where its name is not that of the kind."""


@dataclass(frozen=True)
class ArmParts:
    """An arm by the names of its parts."""

    joints: tuple[str, ...]  # base to tool
    tip: str  # the body at its end, which carries the gripper
    fingers: tuple[str, ...]  # joints beyond
    others: tuple[str, ...]  # tips of other arms


def find_arm(model: mujoco.MjModel, tip: str, joints: Sequence[str]) -> ArmParts:
    """Return the arm that ends at the body or site `tip`, or has these `joints`; of neither is
    told, the longest. Raises `RobotError`."""
    tree = _Tree(model)
    others: list[int] = []
    if joints:
        ids = [_id(model, mujoco.mjtObj.mjOBJ_JOINT, name, "--joints") for name in joints]
        end = int(model.jnt_bodyid[ids[-1]])
    elif tip:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
        body = mujoco.mjtObj.mjOBJ_BODY
        end = int(model.site_bodyid[site]) if site >= 0 else _id(model, body, tip, "--tip")
    else:
        end, others = tree.walk()
    chain = [joint for body in tree.to(end) for joint in tree.joints[body]]
    cut = next((k for k, j in enumerate(chain) if k and OF_GRIPPER.search(_name(model, j))), None)
    if cut is not None and not joints:
        end = int(model.body_parentid[model.jnt_bodyid[chain[cut]]])
        chain = chain[:cut]
    # A mobile base stands: what leads to the arm and has no end.
    while chain and not joints and model.jnt_type[chain[0]] == SCALAR_JOINTS[1]:
        if model.jnt_limited[chain[0]]:
            break
        chain = chain[1:]
    named = tuple(joints) or tuple(_name(model, joint) for joint in chain)
    if not named:
        raise RobotError("no arm: no hinge or slide joints in a row; --tip names a body at its end")
    beyond = np.flatnonzero(below(model, np.array([end]))[model.jnt_bodyid])
    fingers = [_name(model, int(joint)) for joint in beyond if _is_scalar(model, int(joint))]
    return ArmParts(
        named,
        model.body(end).name,
        tuple(name for name in fingers if name not in named),
        tuple(model.body(other).name for other in others),
    )


def hold(path: Path, kept: Iterable[str]) -> list[str]:
    """Take out of an MJCF file, as MuJoCo writes it, all joints but those `kept`, bodies that fly
    or that something outside moves, and what refers to them; return those bodies."""
    tree = ElementTree.parse(path)
    root = tree.getroot()
    moving = {("joint", name) for name in kept}
    gone = set[tuple[str, str]]()
    flying = []
    world = root.find("worldbody")
    assert world is not None, "MuJoCo writes one"
    for body in world.findall("body"):
        own = {(inner.tag, inner.get("name", "")) for inner in body.iter()}
        flies = body.find("freejoint") is not None or body.find("joint[@type='free']") is not None
        if not own & moving and (flies or "mocap" in body.attrib):
            world.remove(body)
            gone |= own
            flying.append(body.get("name", ""))
    for body in world.iter("body"):
        for joint in [*body.findall("joint"), *body.findall("freejoint")]:
            if ("joint", joint.get("name", "")) not in moving:
                body.remove(joint)
                gone.add(("joint", joint.get("name", "")))
    for keys in root.findall("keyframe"):
        root.remove(keys)
    sections = [*world.iter("body"), world]
    sections += [section for tag in REFERRING for section in root.findall(tag)]
    for section in sections:
        for element in list(section):
            named = [*element.items(), *(item for inner in element for item in inner.items())]
            is_frame = section.tag.endswith("body") and element.tag not in ("light", "camera")
            if not is_frame and {(KINDS.get(key, key), value) for key, value in named} & gone:
                section.remove(element)
                gone.add((section.tag, element.get("name", "")))
    tree.write(path)
    return flying


class _Tree:
    """The bodies of a model, with the scalar joints of each and in the longest way beyond."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self.joints: list[list[int]] = [[] for _ in range(model.nbody)]
        for joint in range(model.njnt):
            if _is_scalar(model, joint):
                self.joints[model.jnt_bodyid[joint]].append(joint)
        self.depth = np.array([len(own) for own in self.joints])
        for body in range(model.nbody - 1, 0, -1):
            parent = model.body_parentid[body]
            longer = len(self.joints[parent]) + self.depth[body]
            self.depth[parent] = max(self.depth[parent], longer)

    def walk(self) -> tuple[int, list[int]]:
        """Return the body at the end of the longest arm, and those where others begin."""
        body = 0
        passed = 0
        others: list[int] = []
        while True:
            passed += len(self.joints[body])
            children = np.flatnonzero(self._model.body_parentid == body)
            ways = [int(k) for k in children if k and self.depth[k]]
            ways.sort(key=lambda k: -self.depth[k])
            if not ways:
                return body, others
            longest = self.depth[ways[0]]
            is_even = len(ways) > 1 and self.depth[ways[1]] >= longest - 1
            if is_even and passed >= BASE_JOINTS and longest <= MOST_IN_FINGER:
                return body, others
            others += [k for k in ways[1:] if self.depth[k] >= LEAST_JOINTS]
            body = ways[0]

    def to(self, body: int) -> list[int]:
        """Return the bodies from the base to this one."""
        found = []
        while body:
            found.append(body)
            body = int(self._model.body_parentid[body])
        return found[::-1]


def _id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str, option: str) -> int:
    found = int(mujoco.mj_name2id(model, kind, name))
    if found < 0:
        counts = {mujoco.mjtObj.mjOBJ_JOINT: model.njnt, mujoco.mjtObj.mjOBJ_BODY: model.nbody}
        have = listed([mujoco.mj_id2name(model, kind, k) for k in range(counts[kind])])
        raise RobotError(f"{option}: '{name}' is not in the model; it has: {have}")
    return found


def _is_scalar(model: mujoco.MjModel, joint: int) -> bool:
    return mujoco.mjtJoint(int(model.jnt_type[joint])) in SCALAR_JOINTS


def _name(model: mujoco.MjModel, joint: int) -> str:
    return str(model.joint(joint).name)

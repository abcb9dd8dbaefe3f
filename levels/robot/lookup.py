"""Lookup of the names of a config in a compiled model.

Every mistake is one `RobotError` that lists the valid names.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import mujoco
import numpy as np

from rack.levels.algebra import Ints, Mask
from rack.levels.errors import RobotError
from rack.levels.robot.model import (
    JOINT_DRIVES,
    check_joint_count,
    compile_spec,
    format_names,
    load_spec,
)
from rack.levels.tables import RobotConfig, SceneConfig

COUNT_ATTRIBUTES = {
    "site": "nsite",
    "body": "nbody",
    "geom": "ngeom",
    "joint": "njnt",
    "actuator": "nu",
}
"""Attribute of a model that counts its elements, for each kind of element."""


def find_element(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str, place: str) -> int:
    """Return the id of a named element.

    Args:
        model: The compiled model.
        kind: Kind of the element.
        name: Name of the element.
        place: Config key that contains the name, for the error.

    Raises:
        RobotError: The model has no such element.
    """
    number = mujoco.mj_name2id(model, kind, name)
    if number >= 0:
        return int(number)
    noun = kind.name.removeprefix("mjOBJ_").lower()
    count = getattr(model, COUNT_ATTRIBUTES[noun])
    have = format_names([mujoco.mj_id2name(model, kind, k) or "" for k in range(count)])
    # The tool may also be a body.
    if place == "robot.tool":
        have += "; bodies: " + format_names([model.body(k).name for k in range(model.nbody)])
    raise RobotError(f"{place}: no {noun} '{name}' in the model; it has: {have}")


def find_all(
    model: mujoco.MjModel, kind: mujoco.mjtObj, names: tuple[str, ...], place: str
) -> Ints:
    """Return the ids of named elements.

    Args:
        model: The compiled model.
        kind: Kind of the elements.
        names: Names of the elements.
        place: Config key that contains the names, for the error.

    Raises:
        RobotError: The model does not have one of the elements.
    """
    return np.array([find_element(model, kind, name, place) for name in names], dtype=int)


def find_unknown_names(robot: RobotConfig, scene: SceneConfig) -> Iterator[str]:
    """Yield an error line for each name of an arm's config that the model does not contain.

    Raises:
        RobotError: The model is invalid.
    """
    model = compile_spec(load_spec(robot.model), robot.model)
    kind = mujoco.mjtObj
    is_body = mujoco.mj_name2id(model, kind.mjOBJ_BODY, robot.tool) >= 0
    gripper = robot.gripper
    for element_kind, names, place in (
        (kind.mjOBJ_JOINT, robot.joints, "robot.joints"),
        (kind.mjOBJ_SITE, () if is_body else (robot.tool,), "robot.tool"),
        (kind.mjOBJ_BODY, chain(*robot.exclude), "robot.exclude"),
        (kind.mjOBJ_JOINT, () if gripper is None else (gripper.joint,), "robot.gripper.joint"),
        (kind.mjOBJ_BODY, scene.objects, "scene.objects"),
        (kind.mjOBJ_BODY, scene.obstacles, "scene.obstacles"),
        (kind.mjOBJ_GEOM, scene.supports, "scene.supports"),
    ):
        for name in names:
            try:
                find_element(model, element_kind, name, place)
            except RobotError as error:
                yield str(error)


def find_free_joints(model: mujoco.MjModel, bodies: Ints) -> Ints:
    """Return the ids of the free joints of objects, given the ids of their bodies.

    Raises:
        RobotError: A body has no free joint.
    """
    joints = model.body_jntadr[bodies]
    for body, joint in zip(bodies, joints, strict=True):
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise RobotError(
                f"scene.objects: body '{model.body(body).name}' has no free joint; add"
                " <freejoint/> to it"
            )
    return np.asarray(joints, dtype=int)


def find_mocap_ids(model: mujoco.MjModel, bodies: Ints) -> Ints:
    """Return the mocap ids of obstacles, given the ids of their bodies.

    Raises:
        RobotError: An obstacle is not a mocap body.
    """
    for body in bodies:
        if model.body_mocapid[body] < 0:
            raise RobotError(
                f"scene.obstacles: body '{model.body(body).name}' is not a mocap body; add"
                " mocap='true' to it"
            )
    return np.asarray(model.body_mocapid[bodies], dtype=int)


def mark_descendants(model: mujoco.MjModel, roots: Ints) -> Mask:
    """Return a mask of the bodies `roots` and all their descendants, (nbody,)."""
    marked = np.zeros(model.nbody, dtype=bool)
    marked[roots] = True
    for body in range(1, model.nbody):
        marked[body] |= marked[model.body_parentid[body]]
    return marked


def list_geoms(model: mujoco.MjModel, bodies: Mask) -> Ints:
    """Return the ids of the geoms on the bodies that a mask, (nbody,), selects."""
    return np.flatnonzero(bodies[model.geom_bodyid])


def find_geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Return the name of a geom, or of its body if it has none."""
    return model.geom(geom).name or f"body {model.body(model.geom_bodyid[geom]).name}"


def derive_robot(robot: RobotConfig) -> RobotConfig:
    """Return the `[robot]` table, with missing joints, tool and home filled in from the model.

    Raises:
        RobotError: The model does not determine them.
    """
    model = compile_spec(load_spec(robot.model), robot.model)
    joints = robot.joints or _find_driven_joints(model, robot)
    if not joints:
        raise RobotError("robot.joints: name the joints, because none in the model has an actuator")
    check_joint_count(joints)
    ids = find_all(model, mujoco.mjtObj.mjOBJ_JOINT, joints, "robot.joints")
    start = model.key_qpos[0] if model.nkey else model.qpos0
    home = start[model.jnt_qposadr[ids]].tolist()
    last = int(model.jnt_bodyid[ids[-1]])
    carried = mark_descendants(model, np.array([last]))
    sites = [model.site(k).name for k in np.flatnonzero(carried[model.site_bodyid])]
    named = [name for name in sites if name] or [model.body(last).name]
    return robot.model_copy(
        update={
            "joints": joints,
            "tool": robot.tool or named[-1],
            "home": robot.home or tuple(home),
        }
    )


def _find_driven_joints(model: mujoco.MjModel, robot: RobotConfig) -> tuple[str, ...]:
    """Return the names of the joints with an actuator, except the joints of the gripper."""
    of_joint = np.isin(model.actuator_trntype, JOINT_DRIVES)
    driven = np.unique(model.actuator_trnid[of_joint, 0])
    names = [str(model.joint(k).name) for k in driven]
    gripper = robot.gripper
    gripper_joints = (
        () if gripper is None else (gripper.joint, *(follower.joint for follower in gripper.follow))
    )
    return tuple(name for name in names if name not in gripper_joints)

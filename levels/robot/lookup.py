"""Look up the names of a config in a compiled model. Every mistake is one `RobotError` that lists
the valid names.
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
    check_number,
    compile_spec,
    listed,
    load_spec,
)
from rack.levels.tables import RobotConfig, SceneConfig

COUNTS = {"site": "nsite", "body": "nbody", "geom": "ngeom", "joint": "njnt", "actuator": "nu"}
"""Attributes of a model with the numbers of its elements, by kind."""


def find(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str, place: str) -> int:
    """Return the id of a named element; `place` is the config's key. Raises `RobotError`."""
    found = mujoco.mj_name2id(model, kind, name)
    if found >= 0:
        return int(found)
    noun = kind.name.removeprefix("mjOBJ_").lower()
    count = getattr(model, COUNTS[noun])
    have = listed([mujoco.mj_id2name(model, kind, k) or "" for k in range(count)])
    if place == "robot.tool":  # a body serves as well
        have += "; bodies: " + listed([model.body(k).name for k in range(model.nbody)])
    raise RobotError(f"{place}: no {noun} '{name}' in the model; it has: {have}")


def find_all(
    model: mujoco.MjModel, kind: mujoco.mjtObj, names: tuple[str, ...], place: str
) -> Ints:
    """Return the ids of named elements. Raises `RobotError`."""
    return np.array([find(model, kind, name, place) for name in names], dtype=int)


def unknown_names(robot: RobotConfig, scene: SceneConfig) -> Iterator[str]:
    """Yield a line for every name in the config that the model lacks. Raises `RobotError` for a
    broken model.
    """
    model = compile_spec(load_spec(robot.model), robot.model)
    kind = mujoco.mjtObj
    is_body = mujoco.mj_name2id(model, kind.mjOBJ_BODY, robot.tool) >= 0
    gripper = robot.gripper
    wanted = [
        (kind.mjOBJ_JOINT, robot.joints, "robot.joints"),
        (kind.mjOBJ_SITE, () if is_body else (robot.tool,), "robot.tool"),
        (kind.mjOBJ_BODY, tuple(chain(*robot.exclude)), "robot.exclude"),
        (kind.mjOBJ_JOINT, () if gripper is None else (gripper.joint,), "robot.gripper.joint"),
    ]
    if robot.hand is not None:
        tips = tuple(finger.tip for finger in robot.hand.finger)
        wanted += [
            (kind.mjOBJ_SITE, tips, "robot.hand.finger.tip"),
            (kind.mjOBJ_ACTUATOR, robot.hand.flexors, "robot.hand.flexors"),
            (kind.mjOBJ_ACTUATOR, robot.hand.extensors, "robot.hand.extensors"),
        ]
    wanted += [
        (kind.mjOBJ_BODY, scene.objects, "scene.objects"),
        (kind.mjOBJ_BODY, scene.obstacles, "scene.obstacles"),
        (kind.mjOBJ_GEOM, scene.supports, "scene.supports"),
    ]
    for what, names, place in wanted:
        for name in names:
            try:
                find(model, what, name, place)
            except RobotError as error:
                yield str(error)


def tool_site(model: mujoco.MjModel, name: str, moved: Mask | None) -> int:
    """Return the id of the tool's site, on one of the bodies `moved` (nbody,) by the arm; None: on
    any.

    Raises `RobotError`.
    """
    tool = find(model, mujoco.mjtObj.mjOBJ_SITE, name, "robot.tool")
    if moved is not None and not moved[model.site_bodyid[tool]]:
        raise RobotError(f"robot.tool: '{name}' is on a body that the arm does not move")
    return tool


def free_joints(model: mujoco.MjModel, bodies: Ints) -> Ints:
    """Return the ids of the objects' free joints. Raises `RobotError` for a body without one."""
    joints = model.body_jntadr[bodies]
    for body, joint in zip(bodies, joints, strict=True):
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise RobotError(
                f"scene.objects: body '{model.body(body).name}' has no free joint; give it"
                " <freejoint/>"
            )
    return np.asarray(joints, dtype=int)


def mocap_ids(model: mujoco.MjModel, bodies: Ints) -> Ints:
    """Return the mocap ids of the obstacles. Raises `RobotError` for a body without one."""
    for body in bodies:
        if model.body_mocapid[body] < 0:
            name = model.body(body).name
            raise RobotError(
                f"scene.obstacles: body '{name}' cannot move by itself; give it mocap='true'"
            )
    return np.asarray(model.body_mocapid[bodies], dtype=int)


def below(model: mujoco.MjModel, roots: Ints) -> Mask:
    """Mark (nbody,) the bodies `roots` and their descendants."""
    marked = np.zeros(model.nbody, dtype=bool)
    marked[roots] = True
    for body in range(1, model.nbody):
        marked[body] |= marked[model.body_parentid[body]]
    return marked


def geoms_of(model: mujoco.MjModel, bodies: Mask) -> Ints:
    """Return the ids of the geoms on the bodies marked (nbody,)."""
    return np.flatnonzero(bodies[model.geom_bodyid])


def geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Return a geom's name or, when it has none, its body's."""
    return model.geom(geom).name or f"body {model.body(model.geom_bodyid[geom]).name}"


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

"""The cell: a robot and what stands around it, as one MuJoCo model and the indices into it.

Every task that needs the model builds it from the config by itself: equal files give equal models.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from levels.errors import RobotError
from levels.limits import Limits, joint_limits
from levels.mjcf import compile_spec, load_spec
from levels.motors import fit_gripper, fit_motors, listed
from levels.robot import RobotConfig
from levels.scene import SceneConfig
from levels.touches import below, geom_name, geoms_of, touch_matrix, touching

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
"""All that the next step depends on: restored, a simulation goes on bit for bit."""


@dataclass(frozen=True)
class Cell:
    """A compiled cell. Indices are addresses in `model`; every array with one entry a joint is (joints,).

    - `model`: torque motors on every joint of the arm, a force motor on the gripper; its keyframe 0 is the start: the arm
      at home, the gripper open.
    - `qpos`, `dof`, `actuators`: the arm's joints in qpos, in qvel, and their motors in ctrl.
    - `home`: joint positions at the start, rad.
    - `tool`: site id. `hand`: the body that carries the tool.
    - `gripper_*`: None for an arm without one; `gripper_open` and `gripper_closed` are joint positions, m or rad.
    - `arm_geoms`: geoms that the arm moves, gripper included; `gripper_geoms`: hand and fingers alone.
    - `bodies`: ids in the order of `scene.bodies`; `object_qpos`, `object_dof`: first of 7 and of 6 addresses an object;
      `mocap`: mocap id an obstacle; `supports`: geom ids.
    - `touch`: (ngeom, ngeom), True where a contact is one that no task means.
    """

    model: mujoco.MjModel
    qpos: NDArray[np.int_]
    dof: NDArray[np.int_]
    actuators: NDArray[np.int_]
    home: NDArray[np.float64]
    tool: int
    hand: int
    gripper_qpos: int | None
    gripper_dof: int | None
    gripper_actuator: int | None
    gripper_open: float | None
    gripper_closed: float | None
    arm_geoms: NDArray[np.int_]
    gripper_geoms: NDArray[np.int_]
    bodies: NDArray[np.int_]
    object_qpos: NDArray[np.int_]
    object_dof: NDArray[np.int_]
    mocap: NDArray[np.int_]
    supports: NDArray[np.int_]
    touch: NDArray[np.bool_]
    limits: Limits

    def start(self) -> mujoco.MjData:
        """Return data of the cell's start: the arm at home, the gripper open, objects where the model puts them."""
        data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, data, 0)
        mujoco.mj_forward(self.model, data)
        return data


def build_cell(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> Cell:
    """Build the cell; one servo cycle of `clock_ns` is `robot.substeps` MuJoCo steps.

    Raises `RobotError`, one line, for a file, joint, site, body or geom that is missing or of the wrong kind, a list of
    the wrong length, a home outside the limits or in contact.
    """
    spec = load_spec(robot.model)
    check_lists(robot, spec)
    motors, torque = fit_motors(spec, robot)
    prepare(spec, robot, clock_ns)
    model = compile_spec(spec, robot.model)
    cell = index(model, robot, scene, motors, torque)
    model.key_qpos[0] = start_qpos(cell)
    check_start(cell, robot)
    return cell


def sizes(cell: Cell) -> dict[str, int]:
    """Return the sizes that the cell gives to messages: joints, bodies (at least 1), state."""
    return {
        "joints": len(cell.qpos),
        "bodies": max(1, len(cell.bodies)),
        "state": mujoco.mj_stateSize(cell.model, STATE),
    }


def check_lists(robot: RobotConfig, spec: mujoco.MjSpec) -> None:
    """Raise `RobotError` for joints that the model lacks, twice-named or not scalar, and lists of another length."""
    wanted = len(robot.joints)
    for name in ("home", "velocity", "acceleration", "jerk", "torque", "position"):
        values = getattr(robot, name)
        if values is not None and len(values) != wanted:
            raise RobotError(f"robot.{name}: {len(values)} values; one a joint is {wanted}")
    have = listed([j.name for j in spec.joints])
    for name in robot.joints:
        joint = spec.joint(name)
        if joint is None:
            raise RobotError(f"robot.joints: '{name}' is not in '{robot.model.name}'; joints: {have}")
        if joint.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            raise RobotError(f"robot.joints: '{name}' is a {joint.type.name[6:].lower()} joint; hinge and slide can be driven")
        if robot.joints.count(name) > 1:
            raise RobotError(f"robot.joints: '{name}' is named {robot.joints.count(name)} times; once is valid")


def prepare(spec: mujoco.MjSpec, robot: RobotConfig, clock_ns: int) -> None:
    """Set what the servo level needs in any model: integrator, time step, drive inertia, tool, gripper, keyframe."""
    option = spec.option
    option.timestep = clock_ns * 1e-9 / robot.substeps
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # A reset to t = 0 would hide a broken state; a sleeping body keeps state outside mjSTATE_INTEGRATION.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    for name in robot.joints:
        joint = spec.joint(name)
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.armature = max(joint.armature, robot.min_armature)
    if spec.site(robot.tool) is None and spec.body(robot.tool) is not None:
        spec.body(robot.tool).add_site(name=robot.tool)
    if robot.gripper is not None:
        fit_gripper(spec, robot.gripper)
    for key in list(spec.keys):
        spec.delete(key)  # its controls belong to the actuators that were replaced
    spec.add_key(name="start")


def index(
    model: mujoco.MjModel, robot: RobotConfig, scene: SceneConfig, motors: list[str], torque: NDArray[np.float64]
) -> Cell:
    """Find everything that the config names in the compiled model. Raises `RobotError`."""
    joints = np.array([model.joint(name).id for name in robot.joints])
    tool = find(model, mujoco.mjtObj.mjOBJ_SITE, robot.tool, "robot.tool")
    moved = below(model, model.jnt_bodyid[joints])
    if not moved[model.site_bodyid[tool]]:
        raise RobotError(f"robot.tool: '{robot.tool}' is on a body that the arm does not move")
    gripper = gripper_joint(model, robot, moved)
    bodies = np.array([find(model, mujoco.mjtObj.mjOBJ_BODY, b, "scene") for b in scene.bodies], dtype=int)
    objects = np.array([free_joint(model, b) for b in bodies[: len(scene.objects)]], dtype=int)
    arm_geoms, gripper_geoms = geoms_of(model, moved), hand_geoms(model, gripper)
    object_geoms = geoms_of(model, below(model, bodies[: len(scene.objects)]))
    supports = np.array([find(model, mujoco.mjtObj.mjOBJ_GEOM, g, "scene.supports") for g in scene.supports], dtype=int)
    return Cell(
        model=model,
        qpos=model.jnt_qposadr[joints].astype(int),
        dof=model.jnt_dofadr[joints].astype(int),
        actuators=np.array([model.actuator(name).id for name in motors]),
        home=np.array(robot.home),
        tool=tool,
        hand=int(model.site_bodyid[tool]),
        gripper_qpos=None if gripper is None else int(model.jnt_qposadr[gripper]),
        gripper_dof=None if gripper is None else int(model.jnt_dofadr[gripper]),
        gripper_actuator=None if robot.gripper is None else int(model.actuator(robot.gripper.actuator).id),
        gripper_open=None if robot.gripper is None else robot.gripper.open,
        gripper_closed=None if robot.gripper is None else robot.gripper.closed,
        arm_geoms=arm_geoms,
        gripper_geoms=gripper_geoms,
        bodies=bodies,
        object_qpos=model.jnt_qposadr[objects].astype(int),
        object_dof=model.jnt_dofadr[objects].astype(int),
        mocap=np.array([mocap_id(model, b) for b in bodies[len(scene.objects) :]], dtype=int),
        supports=supports,
        touch=touch_matrix(model, arm_geoms, gripper_geoms, object_geoms, supports),
        limits=joint_limits(model, joints, robot, torque),
    )


def find(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str, place: str) -> int:
    """Return the id of a named element. Raises `RobotError` that lists what the model has of its kind."""
    found = mujoco.mj_name2id(model, kind, name)
    if found >= 0:
        return int(found)
    noun, count = {
        mujoco.mjtObj.mjOBJ_SITE: ("site", model.nsite),
        mujoco.mjtObj.mjOBJ_BODY: ("body", model.nbody),
        mujoco.mjtObj.mjOBJ_GEOM: ("geom", model.ngeom),
        mujoco.mjtObj.mjOBJ_JOINT: ("joint", model.njnt),
    }[kind]
    have = listed([mujoco.mj_id2name(model, kind, k) or "" for k in range(count)])
    raise RobotError(f"{place}: no {noun} '{name}' in the model; it has: {have}")


def gripper_joint(model: mujoco.MjModel, robot: RobotConfig, moved: NDArray[np.bool_]) -> int | None:
    """Return the id of the gripper's joint, None for an arm without one. Raises `RobotError`."""
    if robot.gripper is None:
        return None
    name = robot.gripper.joint
    joint = find(model, mujoco.mjtObj.mjOBJ_JOINT, name, "robot.gripper.joint")
    if name in robot.joints or not moved[model.jnt_bodyid[joint]]:
        raise RobotError(f"robot.gripper.joint: '{name}' must be a joint behind the arm's, not one of them")
    return joint


def hand_geoms(model: mujoco.MjModel, gripper: int | None) -> NDArray[np.int_]:
    """Return the geoms of the body that carries the gripper's joint, and of all that hangs on that body."""
    if gripper is None:
        return np.zeros(0, dtype=int)
    return geoms_of(model, below(model, model.body_parentid[model.jnt_bodyid[[gripper]]]))


def free_joint(model: mujoco.MjModel, body: int) -> int:
    """Return the id of an object's free joint. Raises `RobotError`."""
    joint = int(model.body_jntadr[body])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise RobotError(f"scene.objects: body '{model.body(body).name}' has no free joint; give it <freejoint/>")
    return joint


def mocap_id(model: mujoco.MjModel, body: int) -> int:
    """Return the mocap id of an obstacle. Raises `RobotError`."""
    if model.body_mocapid[body] < 0:
        raise RobotError(f"scene.obstacles: body '{model.body(body).name}' does not move by itself; give it mocap='true'")
    return int(model.body_mocapid[body])


def start_qpos(cell: Cell) -> NDArray[np.float64]:
    """Return qpos of the start: arm at home, gripper open with the fingers geared to it, the rest as the model has it."""
    m = cell.model
    qpos = np.array(m.qpos0)
    qpos[cell.qpos] = cell.home
    if cell.gripper_qpos is None:
        return qpos
    qpos[cell.gripper_qpos] = cell.gripper_open
    for k in np.flatnonzero((m.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (m.eq_obj2id >= 0)):
        first, second = m.jnt_qposadr[m.eq_obj1id[k]], m.jnt_qposadr[m.eq_obj2id[k]]
        if second == cell.gripper_qpos:
            turn = qpos[second] - m.qpos0[second]
            qpos[first] = m.qpos0[first] + np.polynomial.polynomial.polyval(turn, m.eq_data[k, :5])
        elif first == cell.gripper_qpos and m.eq_data[k, 1]:
            turn = qpos[first] - m.qpos0[first]
            qpos[second] = m.qpos0[second] + (turn - m.eq_data[k, 0]) / m.eq_data[k, 1]
    return qpos


def check_start(cell: Cell, robot: RobotConfig) -> None:
    """Raise `RobotError` when home is outside the limits, in a contact that no task means, or not finite."""
    for name, q, (low, high) in zip(robot.joints, cell.home, cell.limits.position, strict=True):
        if not low <= q <= high:
            raise RobotError(f"robot.home: joint '{name}' at {q:g} rad; {low:g} to {high:g} is valid")
    data = cell.start()
    if not np.isfinite(data.qacc).all():
        raise RobotError(f"model '{robot.model}': the acceleration at home is not finite; check masses, inertias and gravity")
    pair = touching(cell.model, data, cell.touch)
    if pair is not None:
        first, second = (geom_name(cell.model, g) for g in pair)
        raise RobotError(f"robot.home: '{first}' touches '{second}'; move home or the object, name a support, or exclude the pair")

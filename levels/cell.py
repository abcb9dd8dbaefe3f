"""The cell: a robot and what stands around it, as one MuJoCo model and the indices into it.

Every task that needs the model builds it from the config by itself: equal files give equal models.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels import cell_index
from rack.levels.errors import RobotError
from rack.levels.gripper import Linkage, solve_linkage
from rack.levels.limits import Bounds, Encoders, Limits, joint_bounds, planned_limits
from rack.levels.mjcf import compile_spec, load_spec
from rack.levels.motors import fit_gripper, fit_motors, listed
from rack.levels.robot import RobotConfig
from rack.levels.scene import SceneConfig
from rack.levels.touches import below, geom_name, geoms_of, touch_matrix, unmeant

__all__ = ["STATE", "Bounds", "Cell", "Limits", "build_cell", "sizes"]

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
"""All that the next step depends on: restored, a simulation goes on bit for bit."""

SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True)
class Cell:
    """A compiled cell. Indices are addresses in `model`; every array with one entry a joint is (joints,).

    - `model`: torque motors on every joint of the arm, a force motor on the gripper; its keyframe 0 is the start: the
      arm at home, the gripper open.
    - `qpos`, `dof`, `actuators`: the arm's joints in qpos, in qvel, and their motors in ctrl.
    - `home`: joint positions at the start, rad. `tool`: site id.
    - `gripper_*`: None for an arm without one; `gripper_open` and `gripper_closed` are joint positions, m or rad, and
      `gripper_stiffness` is that of its position loop, N/m or N m/rad.
    - `linkage`: where all joints of the gripper are, by its opening.
    - `arm_geoms`: geoms that the arm moves, gripper included; `gripper_geoms`: hand and fingers alone.
    - `bodies`: ids in the order of `scene.bodies`; `object_qpos`: first of 7 addresses an object; `mocap`: mocap id an
      obstacle; `supports`: geom ids.
    - `touch`: (ngeom, ngeom), True where a contact is one that no task means.
    - `encoders`: what its sensors resolve.
    - `bounds`: what the arm never exceeds; `limits`: what motion is planned within.
    """

    model: mujoco.MjModel
    qpos: NDArray[np.int_]
    dof: NDArray[np.int_]
    actuators: NDArray[np.int_]
    home: NDArray[np.float64]
    tool: int
    gripper_qpos: int | None
    gripper_dof: int | None
    gripper_actuator: int | None
    gripper_open: float | None
    gripper_closed: float | None
    gripper_stiffness: float | None
    linkage: Linkage | None
    arm_geoms: NDArray[np.int_]
    gripper_geoms: NDArray[np.int_]
    bodies: NDArray[np.int_]
    object_qpos: NDArray[np.int_]
    mocap: NDArray[np.int_]
    supports: NDArray[np.int_]
    touch: NDArray[np.bool_]
    bounds: Bounds
    limits: Limits
    encoders: Encoders

    def start(self) -> mujoco.MjData:
        """Return data of the start: the arm at home, the gripper open, objects where the model puts them."""
        data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, data, 0)
        mujoco.mj_forward(self.model, data)
        return data


def build_cell(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> Cell:
    """Build the cell; one tick of `clock_ns` is `robot.substeps` MuJoCo steps.

    Raises `RobotError`, one line, for a file, joint, site, body or geom that is missing or of the wrong kind, a list of
    the wrong length, a home outside the limits or in a contact that no task means.
    """
    spec = load_spec(robot.model)
    check_joints(robot, spec)
    motors, torque = fit_motors(spec, robot)
    prepare(spec, robot, clock_ns)
    cell = index(compile_spec(spec, robot.model), robot, scene, motors, torque)
    cell.model.key_qpos[0] = start_qpos(cell)
    check_start(cell, robot)
    return cell


def sizes(cell: Cell) -> dict[str, int]:
    """Return the sizes that the cell gives to messages: joints, bodies (at least 1), state."""
    return {
        "joints": len(cell.qpos),
        "bodies": max(1, len(cell.bodies)),
        "state": mujoco.mj_stateSize(cell.model, STATE),
    }


def check_joints(robot: RobotConfig, spec: mujoco.MjSpec) -> None:
    """Raise `RobotError` for a list of another length, and for joints that are missing, not scalar or named twice."""
    wanted = len(robot.joints)
    for name in ("home", "velocity", "acceleration", "jerk", "torque", "position"):
        values = getattr(robot, name)
        if values is not None and len(values) != wanted:
            raise RobotError(f"robot.{name}: {len(values)} values; one a joint is {wanted}")
    for name, given in robot.sensors:
        if isinstance(given, tuple) and len(given) != wanted:
            raise RobotError(f"robot.sensors.{name}: {len(given)} values; one for all joints, or one a joint: {wanted}")
    for name in robot.joints:
        joint = spec.joint(name)
        if joint is None:
            have = listed([j.name for j in spec.joints])
            raise RobotError(f"robot.joints: no joint '{name}' in the model; it has: {have}")
        if joint.type not in SCALAR_JOINTS:
            kind = joint.type.name.removeprefix("mjJNT_").lower()
            raise RobotError(f"robot.joints: '{name}' is a {kind} joint; valid: hinge, slide")
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
        spec.delete(key)  # its controls belong to actuators that were replaced
    spec.add_key(name="start")


def index(
    model: mujoco.MjModel, robot: RobotConfig, scene: SceneConfig, motors: list[str], torque: NDArray[np.float64]
) -> Cell:
    """Find everything that the config names in the compiled model. Raises `RobotError`."""
    joints = np.array([model.joint(name).id for name in robot.joints])
    moved = below(model, model.jnt_bodyid[joints])
    gripper, joint = robot.gripper, cell_index.gripper_joint(model, robot, moved)
    bodies = cell_index.find_all(model, mujoco.mjtObj.mjOBJ_BODY, scene.bodies, "scene")
    objects, obstacles = bodies[: len(scene.objects)], bodies[len(scene.objects) :]
    hand = cell_index.hand(model, joint, joints)
    arm_geoms, gripper_geoms = geoms_of(model, moved), geoms_of(model, hand)
    object_geoms = geoms_of(model, below(model, objects))
    supports = cell_index.find_all(model, mujoco.mjtObj.mjOBJ_GEOM, scene.supports, "scene.supports")
    bounds = joint_bounds(model, joints, robot, torque)
    return Cell(
        model=model,
        qpos=model.jnt_qposadr[joints].astype(int),
        dof=model.jnt_dofadr[joints].astype(int),
        actuators=np.array([model.actuator(name).id for name in motors]),
        home=np.array(robot.home),
        tool=cell_index.tool_site(model, robot.tool, moved),
        gripper_qpos=None if joint is None else int(model.jnt_qposadr[joint]),
        gripper_dof=None if joint is None else int(model.jnt_dofadr[joint]),
        gripper_actuator=None if gripper is None else int(model.actuator(gripper.actuator).id),
        gripper_open=None if gripper is None else gripper.open,
        gripper_closed=None if gripper is None else gripper.closed,
        gripper_stiffness=None if gripper is None else gripper.stiffness,
        linkage=None
        if gripper is None or joint is None
        else solve_linkage(model, joint, hand, (gripper.open, gripper.closed)),
        arm_geoms=arm_geoms,
        gripper_geoms=gripper_geoms,
        bodies=bodies,
        object_qpos=model.jnt_qposadr[cell_index.free_joints(model, objects)].astype(int),
        mocap=cell_index.mocap_ids(model, obstacles),
        supports=supports,
        touch=touch_matrix(model, arm_geoms, gripper_geoms, object_geoms, supports),
        bounds=bounds,
        limits=planned_limits(bounds, robot),
        encoders=Encoders.of(robot),
    )


def start_qpos(cell: Cell) -> NDArray[np.float64]:
    """Return qpos of the start: arm at home, gripper and all that follows it open, the rest as in the model."""
    qpos = np.array(cell.model.qpos0)
    qpos[cell.qpos] = cell.home
    if cell.linkage is not None and cell.gripper_open is not None:
        cell.linkage.set(qpos, cell.gripper_open)
    return qpos


def check_start(cell: Cell, robot: RobotConfig) -> None:
    """Raise `RobotError` when home is outside the limits, too heavy to hold, in a touch, or not finite."""
    for name, q, (low, high) in zip(robot.joints, cell.home, cell.limits.position, strict=True):
        if not low <= q <= high:
            raise RobotError(f"robot.home: joint '{name}' at {q:g} rad; {low:g} to {high:g} is valid")
    data = cell.start()
    if not np.isfinite(data.qacc).all():
        raise RobotError(f"model '{robot.model}': acceleration at home is not finite; check masses, inertias, gravity")
    load = np.abs(data.qfrc_bias - data.qfrc_passive)[cell.dof]
    for name, needed, limit in zip(robot.joints, load, cell.bounds.torque, strict=True):
        if needed > limit:
            raise RobotError(
                f"robot.home: joint '{name}' carries {needed:.4g} N m there; its torque limit is {limit:g}"
            )
    for pair in unmeant(data, cell.touch):
        first, second = (geom_name(cell.model, geom) for geom in pair)
        raise RobotError(
            f"robot.home: '{first}' touches '{second}'; move home or the object, name a support, or exclude the pair"
        )

"""The cell: a robot and its surroundings, as one MuJoCo model with indices into it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array, Ints, Mask
from rack.levels.errors import RobotError
from rack.levels.level import LevelContext
from rack.levels.robot import lookup
from rack.levels.robot.engine import compute_state_size, set_margins
from rack.levels.robot.hand import Hand, find_hand, fit_tendons
from rack.levels.robot.limits import (
    Bounds,
    Encoders,
    Limits,
    MotorPatience,
    compute_patience,
    compute_planned_limits,
    find_joint_bounds,
)
from rack.levels.robot.linkage import Linkage, check_couplings, solve_linkage
from rack.levels.robot.model import check_joints, compile_spec, fit_motors, load_spec, prepare_spec
from rack.levels.robot.wrist import Wrist, find_wrist
from rack.levels.tables import GripperConfig, Interface, RobotConfig, SceneConfig, SensorConfig

TOUCHING_M = 5e-5
"""Distance, in m, below which geoms at home are treated as touching.

At smaller distances, rounding would determine whether they touch.
"""
SETTLING_S = 1.0
"""Time in which the fingers of a gripper come to rest, in s."""


@dataclass(frozen=True)
class Gripper:
    """An arm's gripper, driven at one joint. Indices are addresses in the model."""

    dof: int  # address of the driven joint in qvel
    actuator: int
    open: float  # joint position, m or rad
    closed: float  # joint position when closed without an object, m or rad
    stiffness: float  # of the gripper's position loop, N/m or N m/rad
    linkage: Linkage  # positions of all its joints as functions of its opening


class CellGeoms(NamedTuple):
    """Ids of the geoms whose contacts are checked."""

    arm: Ints  # all that the arm moves, including the gripper's
    gripper: Ints  # of the body that carries the gripper, and of the fingers
    supports: Ints  # in the order of `scene.supports`
    touch: Mask  # (ngeom, ngeom), True where a contact is unintended


@dataclass(frozen=True)
class Cell:
    """A compiled cell. Indices refer to the arrays of `model`."""

    model: mujoco.MjModel
    """Model with torque motors on all joints of the arm and a force motor on the gripper. The model
    of a hand has actuators on the tendons instead. Keyframe 0 is the start, with the gripper open.
    """

    # The arm, or a hand in its place.
    joints: tuple[str, ...]  # names
    qpos: Ints  # (joints,), addresses of the joints in qpos
    dof: Ints  # (joints,), addresses of the joints in qvel
    actuators: Ints  # (joints,), motors in ctrl; the flexors of a hand
    home: Array  # (joints,), rad: where tasks return to
    begin: Array  # (joints,), rad: positions at the start
    tool: int  # site

    # Limits, sensors and drives of the arm.
    bounds: Bounds  # never exceeded, even during a fault
    limits: Limits  # of planned motion
    encoders: Encoders  # resolution and noise of the joints' sensors
    patience: MotorPatience  # of the motors or valves
    interface: Interface  # of the drives
    homing: bool  # drives have to find their reference before they know their position

    # Devices that the arm carries.
    gripper: Gripper | None  # None for an arm without a gripper
    wrist: Wrist | None  # None for an arm without a force/torque sensor
    hand: Hand | None  # None for an arm

    # The surroundings.
    bodies: Ints  # objects, then obstacles, in the order of `scene.bodies`
    object_qpos: Ints  # (objects,), address of the first of the 7 coordinates of each object
    mocap: Ints  # (obstacles,), mocap ids
    geoms: CellGeoms

    def build_start_data(self) -> mujoco.MjData:
        """Return new MuJoCo data, with the arm at its start position.

        The gripper is open, and objects are where the model places them.
        """
        data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, data, 0)
        mujoco.mj_forward(self.model, data)
        return data

    def find_pose(self, row: int) -> slice:
        """Return where the pose of an object is in the coordinates, given its index in `bodies`."""
        address = self.object_qpos[row]
        return slice(address, address + 7)

    def list_geoms(self, row: int) -> Ints:
        """Return the ids of the geoms of an object or obstacle, given its index in `bodies`."""
        model = self.model
        return np.flatnonzero(model.body_rootid[model.geom_bodyid] == self.bodies[row])


def build_cell(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> Cell:
    """Build the cell of a rack.

    The crate builds it once, before it forks the boards. Later calls in the same process only copy
    the model. Each caller gets a separate model.

    Args:
        robot: The `[robot]` table.
        scene: The `[scene]` table.
        clock_ns: Duration of a tick, ns, which is `robot.substeps` MuJoCo steps.

    Raises:
        RobotError: A file, joint, site, body or geom is missing or of the wrong kind, a list has
            the wrong length, or home is outside the limits or in unintended contact. The text is
            one line.
    """
    cell = _build_cached(robot, scene, clock_ns)
    return replace(cell, model=copy(cell.model))


def build_level_cell(context: LevelContext) -> Cell:
    """Build the cell of the rack to which a level belongs; see `build_cell`."""
    return build_cell(context.robot, context.scene, context.clock_ns)


@lru_cache(maxsize=4)
def _build_cached(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> Cell:
    """Build and check a cell, and cache it for later calls in this process."""
    cell = build_unchecked_cell(robot, scene, clock_ns)
    for key, position in (("home", cell.home), ("start", cell.begin)):
        cell.model.key_qpos[0] = build_start_qpos(cell, position)
        check_start(cell, robot, key, position)
    if robot.gripper is not None:
        check_fingers(cell, robot.gripper)
    return cell


def build_unchecked_cell(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> Cell:
    """Build the cell like `build_cell`, without checking the start and the gripper.

    Args:
        robot: The `[robot]` table.
        scene: The `[scene]` table.
        clock_ns: Duration of a tick, ns.

    Raises:
        RobotError: As for `build_cell`.
    """
    spec = load_spec(robot.model)
    check_joints(robot, spec)
    if robot.hand is None:
        motors, torque = fit_motors(spec, robot)
    else:
        motors, torque = fit_tendons(spec, robot, robot.hand, clock_ns * 1e-9 / robot.substeps)
    prepare_spec(spec, robot, clock_ns)
    model = compile_spec(spec, robot.model)
    check_couplings(model, robot.joints)
    cell = assemble_cell(model, robot, scene, motors, torque)
    if robot.gripper is not None and fix_gripper_model(cell, spec, robot.gripper, clock_ns * 1e-9):
        cell = assemble_cell(compile_spec(spec, robot.model), robot, scene, motors, torque)
    cell.model.key_qpos[0] = build_start_qpos(cell, cell.begin)
    return cell


def replace_encoders(cell: Cell, robot: RobotConfig, sensors: SensorConfig) -> Cell:
    """Return the cell with `sensors` as its encoders, unless `[robot.sensors]` defines others."""
    tick_s = robot.substeps * cell.model.opt.timestep
    return replace(cell, encoders=Encoders.from_config(robot, tick_s, sensors))


def compute_sizes(cell: Cell) -> dict[str, int]:
    """Return the symbolic sizes of messages in this cell.

    They are "joints", "bodies" (at least 1), "state", and "fingers" for a hand.
    """
    by_name = {
        "joints": len(cell.qpos),
        "bodies": max(1, len(cell.bodies)),
        "state": compute_state_size(cell.model),
    }
    return by_name if cell.hand is None else {**by_name, "fingers": len(cell.hand.names)}


def assemble_cell(
    model: mujoco.MjModel,
    robot: RobotConfig,
    scene: SceneConfig,
    motors: list[str],
    torque: Array,
) -> Cell:
    """Find all elements that the config names in the compiled model, and return the cell.

    Args:
        model: The compiled model.
        robot: The `[robot]` table.
        scene: The `[scene]` table.
        motors: Names of the motors, one per joint.
        torque: Torque limits of an arm, (joints,), N m. The limits of a hand follow from its
            tendons.

    Raises:
        RobotError: An element is missing or of the wrong kind.
    """
    joints = np.array([model.joint(name).id for name in robot.joints])
    moved = lookup.mark_descendants(model, model.jnt_bodyid[joints])
    hand = None if robot.hand is None else find_hand(model, robot, robot.hand)
    name = robot.tool_name
    tool = lookup.find_element(model, mujoco.mjtObj.mjOBJ_SITE, name, "robot.tool")
    if hand is None and not moved[model.site_bodyid[tool]]:
        raise RobotError(f"robot.tool: '{name}' is on a body that the arm does not move")
    gripper, linked = find_gripper(model, robot, moved, joints)
    if hand is not None:
        # The palm is a part of the hand, although no joint of the hand moves it.
        linked = moved = lookup.mark_descendants(model, model.site_bodyid[[tool]]) | moved
    wrist = find_wrist(model, robot.wrist, moved)
    bodies = lookup.find_all(model, mujoco.mjtObj.mjOBJ_BODY, scene.bodies, "scene")
    objects, obstacles = np.split(bodies, [len(scene.objects)])
    bounds = find_joint_bounds(model, joints, robot, torque if hand is None else hand.torque)
    return Cell(
        model=model,
        joints=robot.joints,
        qpos=model.jnt_qposadr[joints].astype(int),
        dof=model.jnt_dofadr[joints].astype(int),
        actuators=np.array([model.actuator(name).id for name in motors]),
        home=np.array(robot.home),
        begin=np.array(robot.start or robot.home),
        tool=tool,
        bounds=bounds,
        limits=compute_planned_limits(bounds, robot),
        encoders=Encoders.from_config(robot, robot.substeps * model.opt.timestep),
        patience=compute_patience(robot, bounds, compute_full_speed_energy(model, joints, robot)),
        interface=robot.interface,
        homing=robot.calibration.homing,
        gripper=gripper,
        wrist=wrist,
        hand=hand,
        bodies=bodies,
        object_qpos=model.jnt_qposadr[lookup.find_free_joints(model, objects)].astype(int),
        mocap=lookup.find_mocap_ids(model, obstacles),
        geoms=find_geoms(model, scene, moved, linked, objects, wrist),
    )


def find_geoms(
    model: mujoco.MjModel,
    scene: SceneConfig,
    moved: Mask,
    linked: Mask,
    objects: Ints,
    wrist: Wrist | None,
) -> CellGeoms:
    """Return the geoms of a cell, and which of their contacts are unintended.

    Contacts of an object with a support or the gripper, between parts of one object, and between
    fingers are intended. So are contacts between a support and the bodies that a wrist sensor
    carries, because the sensor measures them. Every other contact of arm or object is unintended.
    Contacts between other geoms are ignored.

    Args:
        model: The compiled model.
        scene: The `[scene]` table, which names the supports.
        moved: (nbody,), the bodies that the arm moves.
        linked: (nbody,), the bodies of the gripper.
        objects: Ids of the bodies of the objects.
        wrist: The force/torque sensor. None if the arm has none.

    Raises:
        RobotError: A support is missing.
    """
    arm = lookup.list_geoms(model, moved)
    gripper = lookup.list_geoms(model, linked)
    loose = lookup.list_geoms(model, lookup.mark_descendants(model, objects))
    supports = lookup.find_all(model, mujoco.mjtObj.mjOBJ_GEOM, scene.supports, "scene.supports")
    touch = np.zeros((model.ngeom, model.ngeom), dtype=bool)
    judged = np.union1d(arm, loose)
    touch[judged, :] = touch[:, judged] = True
    intended = [(loose, supports), (loose, gripper), (gripper, gripper)]
    if wrist is not None:
        sensed = lookup.mark_descendants(model, model.site_bodyid[[wrist.site]])
        intended.append((lookup.list_geoms(model, sensed), supports))
    for first, second in intended:
        touch[np.ix_(first, second)] = touch[np.ix_(second, first)] = False
    root = model.body_rootid[model.geom_bodyid]
    touch[np.ix_(loose, loose)] &= root[loose][:, None] != root[loose][None, :]
    return CellGeoms(arm, gripper, supports, touch)


def compute_full_speed_energy(model: mujoco.MjModel, joints: Ints, robot: RobotConfig) -> float:
    """Return the kinetic energy of the arm at home with all joints at full speed, in J."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[joints]] = robot.home
    data.qvel[model.jnt_dofadr[joints]] = robot.velocity
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_energyVel(model, data)
    return float(data.energy[1])


def find_gripper(
    model: mujoco.MjModel, robot: RobotConfig, moved: Mask, arm: Ints
) -> tuple[Gripper | None, Mask]:
    """Find the gripper and its bodies.

    The gripper consists of the body that carries the linkage and all descendants of that body. The
    driven joint may be anywhere in the linkage.

    Args:
        model: The compiled model.
        robot: The `[robot]` table.
        moved: The bodies that the arm moves, (nbody,).
        arm: Joints of the arm, none of which is part of the linkage.

    Returns:
        The gripper, and a mask of its bodies, (nbody,). None and an empty mask if the arm has no
        gripper.

    Raises:
        RobotError: The arm does not carry the gripper's joint, or the linkage cannot be solved.
    """
    config = robot.gripper
    if config is None:
        return None, np.zeros(model.nbody, dtype=bool)
    name = config.joint
    joint = lookup.find_element(model, mujoco.mjtObj.mjOBJ_JOINT, name, "robot.gripper.joint")
    body = model.jnt_bodyid[joint]
    if name in robot.joints or not moved[body]:
        raise RobotError(
            f"robot.gripper.joint: '{name}' must be a joint that the arm carries, and not be in"
            " robot.joints"
        )
    while (
        (parent := model.body_parentid[body])
        and model.body_jntnum[parent]
        and parent not in model.jnt_bodyid[arm]
    ):
        body = parent
    linked = lookup.mark_descendants(model, model.body_parentid[[body]])
    gripper = Gripper(
        dof=int(model.jnt_dofadr[joint]),
        actuator=int(model.actuator(config.actuator).id),
        open=config.open,
        closed=config.closed,
        stiffness=config.gains[0],
        linkage=solve_linkage(model, config, linked, arm),
    )
    return gripper, linked


def find_unintended_contacts(
    data: mujoco.MjData, touch: Mask, within: float = 0.0
) -> NDArray[np.int32]:
    """Return the pairs of geoms that are in unintended contact, (n, 2).

    Args:
        data: Data of the model.
        touch: See `CellGeoms`.
        within: Distance below which geoms count as in contact, m.
    """
    contact = data.contact
    pairs: NDArray[np.int32] = contact.geom
    return np.asarray(pairs[touch[pairs[:, 0], pairs[:, 1]] & (contact.dist < within)])


def fix_gripper_model(
    cell: Cell, spec: mujoco.MjSpec, config: GripperConfig, tick_s: float
) -> bool:
    """Change a model that would prevent the gripper from moving or make it oscillate.

    Links that overlap when the gripper is open or half open, before its fingers meet, are excluded
    from contact. Links overlap at their pins, and because MuJoCo simulates meshes by their convex
    hulls. If the inertia of the drive is too small for the damping of its position loop, the
    missing inertia is added, as `min_armature` does for the joints of the arm.

    Args:
        cell: The cell, with a gripper.
        spec: The model, which is changed.
        config: The `[robot.gripper]` table.
        tick_s: Duration of a tick, s.

    Returns:
        True if anything was changed.
    """
    model = cell.model
    gripper = cell.gripper
    assert gripper is not None, "the config has one"
    data = mujoco.MjData(model)
    overlaps = set()
    for opening in (gripper.open, compute_half_opening(gripper)):
        gripper.linkage.set_opening(data.qpos, opening)
        mujoco.mj_fwdPosition(model, data)
        contact = data.contact
        overlap = np.isin(contact.geom, cell.geoms.gripper).all(axis=1) & (contact.dist < 0.0)
        bodies = model.geom_bodyid[contact.geom[overlap]].tolist()
        overlaps |= set(map(tuple, map(sorted, bodies)))
    names = [[model.body(body).name for body in pair] for pair in sorted(overlaps)]
    named = [*filter(all, names)]
    for first, second in named:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    missing = config.gains[1] * tick_s - float(model.dof_M0[gripper.dof])  # kg or kg m2
    if missing > 0.0:
        spec.joint(config.joint).armature += missing
    return bool(named) or missing > 0.0


def build_start_qpos(cell: Cell, position: Array) -> Array:
    """Return the initial qpos, with the arm at `position`, (joints,), rad.

    The gripper and its linkage are open. Everything else is as in the model.
    """
    qpos = np.array(cell.model.qpos0)
    qpos[cell.qpos] = position
    if cell.gripper is not None:
        cell.gripper.linkage.set_opening(qpos, cell.gripper.open)
    return qpos


def check_start(cell: Cell, robot: RobotConfig, key: str, position: Array) -> None:
    """Check that the arm can start at a position.

    Args:
        cell: The cell, whose keyframe is at this position.
        robot: The `[robot]` table.
        key: Key of the position in the table, for the error.
        position: The position, (joints,), rad.

    Raises:
        RobotError: The position is outside the limits, too heavy to hold, in unintended contact, or
            has an acceleration that is not finite.
    """
    for name, q, (low, high) in zip(robot.joints, position, cell.limits.position, strict=True):
        if not low <= q <= high:
            raise RobotError(
                f"robot.{key}: joint '{name}' is at {q:g} rad; it must be {low:g} to {high:g}"
            )
    data = cell.build_start_data()
    if not np.isfinite(data.qacc).all():
        raise RobotError(
            f"model '{robot.model}': the acceleration at {key} is not finite; check masses,"
            " inertias, gravity"
        )
    load = np.abs(data.qfrc_bias - data.qfrc_passive)[cell.dof]
    for name, needed, limit in zip(robot.joints, load, cell.bounds.torque, strict=True):
        if needed > limit:
            raise RobotError(
                f"robot.{key}: joint '{name}' needs {needed:.4g} N m to hold; its torque limit is"
                f" {limit:g}"
            )
    # Surfaces at a distance of 0.0 mm are not in contact yet, but the first motion would make them
    # touch.
    padded = copy(cell.model)
    set_margins(padded, padded.geom_margin + TOUCHING_M)
    data = replace(cell, model=padded).build_start_data()
    for pair in find_unintended_contacts(data, cell.geoms.touch, TOUCHING_M):
        first, second = (lookup.find_geom_name(cell.model, geom) for geom in pair)
        raise RobotError(
            f"robot.{key}: '{first}' touches '{second}'; move {key} or the object, name a support,"
            " or exclude the pair"
        )


def check_fingers(cell: Cell, config: GripperConfig) -> None:
    """Check by simulation that the gripper moves and its fingers settle where planning expects.

    A gripper is only checked if its couplings yield.

    Raises:
        RobotError: The gripper does not open or close, or fingers settle farther than
            `config.residual` from their planned pose.
    """
    gripper = cell.gripper
    if gripper is None or not gripper.linkage.yields:
        return
    model = cell.model
    stiffness, damping = config.gains
    for goal, start in ((config.open, config.open), (config.closed, compute_half_opening(config))):
        data = cell.build_start_data()
        gripper.linkage.set_opening(data.qpos, start)
        for _ in range(round(SETTLING_S / model.opt.timestep)):
            data.qpos[cell.qpos] = cell.home
            data.qvel[cell.dof] = 0.0
            opening = float(data.qpos[gripper.linkage.driven])
            pull = stiffness * (goal - opening) - damping * data.qvel[gripper.dof]
            data.ctrl[gripper.actuator] = np.clip(pull, -config.force, config.force)
            mujoco.mj_step(model, data)
        if not abs(opening - goal) <= abs(start - goal) + config.rest_threshold:
            raise RobotError(
                f"robot.gripper.force: {config.force:g} does not move the gripper from"
                f" {start:.4g} to {goal:.4g}: it settles at {opening:.4g}"
            )
        settled = data.geom_xpos[cell.geoms.gripper].copy()
        gripper.linkage.set_opening(data.qpos, float(data.qpos[gripper.linkage.driven]))
        mujoco.mj_kinematics(model, data)
        error_m = float(
            np.max(np.linalg.norm(data.geom_xpos[cell.geoms.gripper] - settled, axis=1))
        )
        if not error_m <= config.residual:
            raise RobotError(
                f"robot.gripper: couplings yield: at {opening:.4g} a finger settles"
                f" {error_m * 1e3:.1f} mm from its planned pose; robot.gripper.residual permits"
                f" {config.residual * 1e3:.1f} mm"
            )


def compute_half_opening(gripper: GripperConfig | Gripper) -> float:
    """Return the opening halfway between open and closed, in m or rad."""
    return 0.5 * (gripper.open + gripper.closed)

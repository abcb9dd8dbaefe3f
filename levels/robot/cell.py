"""The cell: a robot and its surroundings, as one MuJoCo model and the indices into it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.errors import RobotError
from rack.levels.robot import lookup
from rack.levels.robot.hand import Hand, find_hand, fit_tendons
from rack.levels.robot.limits import (
    Bounds,
    Encoders,
    Limits,
    MotorPatience,
    joint_bounds,
    patience_of,
    planned_limits,
)
from rack.levels.robot.linkage import Linkage, solve_linkage
from rack.levels.robot.model import check_joints, compile_spec, fit_motors, load_spec, prepare
from rack.levels.robot.wrist import Wrist, find_wrist
from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig, SensorConfig

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""Everything the next step depends on: a simulation restored from it continues bit for bit."""


@dataclass(frozen=True)
class Gripper:
    """An arm's gripper, driven at one joint. Indices are addresses in the model."""

    dof: int  # the driven joint in qvel
    actuator: int
    open: float  # joint position, m or rad
    closed: float  # joint position when closed without a part, m or rad
    stiffness: float  # of the gripper's position loop, N/m or N m/rad
    linkage: Linkage  # positions of all its joints, by its opening


@dataclass(frozen=True)
class Cell:
    """A compiled cell. Indices are addresses in `model`."""

    model: mujoco.MjModel
    """Torque motors on every joint of an arm, a force motor on the gripper; of a hand, its tendons.
    Keyframe 0 is the start, the gripper open."""
    qpos: NDArray[np.int_]  # (joints,), the arm's joints in qpos
    dof: NDArray[np.int_]  # (joints,), the same in qvel
    actuators: NDArray[np.int_]  # (joints,), their motors in ctrl; of a hand, its flexors
    home: NDArray[np.float64]  # (joints,), rad: where tasks return to
    begin: NDArray[np.float64]  # (joints,), rad: positions at the start
    homing: bool  # drives know no position before they are enabled: they find their reference
    tool: int  # site
    gripper: Gripper | None  # None: there is none
    arm_geoms: NDArray[np.int_]  # geoms that the arm moves, gripper included
    gripper_geoms: NDArray[np.int_]  # those of hand and fingers
    bodies: NDArray[np.int_]  # in the order of `scene.bodies`
    object_qpos: NDArray[np.int_]  # (objects,), first of 7 addresses of each object
    mocap: NDArray[np.int_]  # (obstacles,), mocap ids
    supports: NDArray[np.int_]  # geoms
    touch: NDArray[np.bool_]  # (ngeom, ngeom), True where a contact is unintended
    bounds: Bounds  # that the arm never exceeds
    limits: Limits  # of planned motion
    encoders: Encoders  # resolution and noise of its sensors
    wrist: Wrist | None  # force/torque sensor; None: there is none
    hand: Hand | None  # None for an arm
    patience: MotorPatience  # of its motors, or valves

    def start(self) -> mujoco.MjData:
        """Return data of the start: the gripper is open, objects are where the model puts them."""
        data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, data, 0)
        mujoco.mj_forward(self.model, data)
        return data


def build_cell(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> Cell:
    """Build the cell; one tick of `clock_ns` is `robot.substeps` MuJoCo steps. Each caller gets a
    model of its own.

    The crate builds it once, before it forks the boards; in the same process only the model is
    copied from then on.

    Raises `RobotError`, one line, for a file, joint, site, body or geom that is missing or of the
    wrong kind, a list of the wrong length, a home outside the limits or in unintended contact.
    """
    cell = _compiled(robot, scene, clock_ns)
    return replace(cell, model=copy(cell.model))


@lru_cache(maxsize=4)
def _compiled(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> Cell:
    spec = load_spec(robot.model)
    check_joints(robot, spec)
    if robot.hand is None:
        motors, torque = fit_motors(spec, robot)
    else:
        motors, torque = fit_tendons(spec, robot, robot.hand, clock_ns * 1e-9 / robot.substeps)
    prepare(spec, robot, clock_ns)
    cell = index(compile_spec(spec, robot.model), robot, scene, motors, torque)
    for key, position in (("home", cell.home), ("start", cell.begin)):
        cell.model.key_qpos[0] = start_qpos(cell, position)
        check_start(cell, robot, key, position)
    return cell


def sensed_by(cell: Cell, robot: RobotConfig, sensors: SensorConfig) -> Cell:
    """Return the cell with encoders of `sensors`, unless `[robot.sensors]` says what they are."""
    tick_s = robot.substeps * cell.model.opt.timestep
    return replace(cell, encoders=Encoders.of(robot, tick_s, sensors))


def sizes(cell: Cell) -> dict[str, int]:
    """Return the sizes that the cell gives to messages: joints, bodies (at least 1), state; fingers
    of a hand."""
    found = {
        "joints": len(cell.qpos),
        "bodies": max(1, len(cell.bodies)),
        "state": mujoco.mj_stateSize(cell.model, STATE),
    }
    return found if cell.hand is None else {**found, "fingers": len(cell.hand.names)}


def index(
    model: mujoco.MjModel,
    robot: RobotConfig,
    scene: SceneConfig,
    motors: list[str],
    torque: NDArray[np.float64],
) -> Cell:
    """Find everything that the config names in the compiled model, the torques of a hand there.
    Raises `RobotError`."""
    joints = np.array([model.joint(name).id for name in robot.joints])
    moved = lookup.below(model, model.jnt_bodyid[joints])
    hand = None if robot.hand is None else find_hand(model, robot, robot.hand)
    tool = lookup.tool_site(model, robot.tool, moved if hand is None else None)
    joint = lookup.gripper_joint(model, robot, moved)
    bodies = lookup.find_all(model, mujoco.mjtObj.mjOBJ_BODY, scene.bodies, "scene")
    objects = bodies[: len(scene.objects)]
    obstacles = bodies[len(scene.objects) :]
    linked = lookup.hand(model, joint, joints)
    if hand is not None:  # the palm, which its joints do not move, is a part of a hand
        linked = moved = lookup.below(model, model.site_bodyid[[tool]]) | moved
    arm_geoms = lookup.geoms_of(model, moved)
    gripper_geoms = lookup.geoms_of(model, linked)
    object_geoms = lookup.geoms_of(model, lookup.below(model, objects))
    supports = lookup.find_all(model, mujoco.mjtObj.mjOBJ_GEOM, scene.supports, "scene.supports")
    bounds = joint_bounds(model, joints, robot, hand.torque if hand is not None else torque)
    wrist = find_wrist(model, robot.wrist, moved)
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[joints]] = robot.home
    data.qvel[model.jnt_dofadr[joints]] = robot.velocity
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_energyVel(model, data)
    return Cell(
        model=model,
        qpos=model.jnt_qposadr[joints].astype(int),
        dof=model.jnt_dofadr[joints].astype(int),
        actuators=np.array([model.actuator(name).id for name in motors]),
        home=np.array(robot.home),
        begin=np.array(robot.start or robot.home),
        homing=robot.calibration.homing,
        tool=tool,
        gripper=_gripper(model, robot.gripper, joint, linked),
        arm_geoms=arm_geoms,
        gripper_geoms=gripper_geoms,
        bodies=bodies,
        object_qpos=model.jnt_qposadr[lookup.free_joints(model, objects)].astype(int),
        mocap=lookup.mocap_ids(model, obstacles),
        supports=supports,
        touch=unintended_pairs(model, arm_geoms, gripper_geoms, object_geoms, supports)
        & ~pressed_pairs(model, wrist, supports),
        bounds=bounds,
        limits=planned_limits(bounds, robot),
        encoders=Encoders.of(robot, robot.substeps * model.opt.timestep),
        wrist=wrist,
        hand=hand,
        patience=patience_of(robot, bounds, data.energy[1]),
    )


def unintended_pairs(
    model: mujoco.MjModel,
    arm: NDArray[np.int_],
    gripper: NDArray[np.int_],
    objects: NDArray[np.int_],
    supports: NDArray[np.int_],
) -> NDArray[np.bool_]:
    """Return (ngeom, ngeom), True where a contact of two geoms is unintended.

    Intended are an object on a support, an object in the gripper, the parts of one object and the
    fingers on each other; and, see `pressed_pairs`, a tool on a support. Every other contact of arm
    or object is unintended; the rest of the cell is ignored.
    """
    touch = np.zeros((model.ngeom, model.ngeom), dtype=bool)
    ours = np.union1d(arm, objects)
    touch[ours, :] = touch[:, ours] = True
    for first, second in ((objects, supports), (objects, gripper), (gripper, gripper)):
        touch[np.ix_(first, second)] = touch[np.ix_(second, first)] = False
    root = model.body_rootid[model.geom_bodyid]
    touch[np.ix_(objects, objects)] &= root[objects][:, None] != root[objects][None, :]
    return touch


def pressed_pairs(
    model: mujoco.MjModel, wrist: Wrist | None, supports: NDArray[np.int_]
) -> NDArray[np.bool_]:
    """Return (ngeom, ngeom), True for a support and what hangs on the wrist sensor: their contact
    is measured."""
    pressed = np.zeros((model.ngeom, model.ngeom), dtype=bool)
    if wrist is not None:
        tool = lookup.geoms_of(model, lookup.below(model, model.site_bodyid[[wrist.site]]))
        pressed[np.ix_(tool, supports)] = pressed[np.ix_(supports, tool)] = True
    return pressed


def unintended_contacts(data: mujoco.MjData, touch: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return the pairs of geoms, (n, 2), in unintended contact; `touch` is that of `Cell`."""
    contact = data.contact
    pairs: NDArray[np.int32] = contact.geom
    return np.asarray(pairs[touch[pairs[:, 0], pairs[:, 1]] & (contact.dist < 0.0)])


def _gripper(
    model: mujoco.MjModel,
    config: GripperConfig | None,
    joint: int | None,
    linked: NDArray[np.bool_],
) -> Gripper | None:
    if config is None or joint is None:
        return None
    return Gripper(
        dof=int(model.jnt_dofadr[joint]),
        actuator=int(model.actuator(config.actuator).id),
        open=config.open,
        closed=config.closed,
        stiffness=config.stiffness,
        linkage=solve_linkage(model, joint, linked, (config.open, config.closed)),
    )


def start_qpos(cell: Cell, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return qpos of a start: arm at `position`, gripper and its linkage open, the rest as in the
    model."""
    qpos = np.array(cell.model.qpos0)
    qpos[cell.qpos] = position
    if cell.gripper is not None:
        cell.gripper.linkage.set(qpos, cell.gripper.open)
    return qpos


def check_start(cell: Cell, robot: RobotConfig, key: str, position: NDArray[np.float64]) -> None:
    """Raise `RobotError` when the start at robot.`key` is outside the limits, too heavy to hold, in
    unintended contact, or not finite."""
    for name, q, (low, high) in zip(robot.joints, position, cell.limits.position, strict=True):
        if not low <= q <= high:
            raise RobotError(
                f"robot.{key}: joint '{name}' at {q:g} rad; {low:g} to {high:g} is valid"
            )
    data = cell.start()
    if not np.isfinite(data.qacc).all():
        raise RobotError(
            f"model '{robot.model}': acceleration at {key} is not finite; check masses, inertias,"
            " gravity"
        )
    load = np.abs(data.qfrc_bias - data.qfrc_passive)[cell.dof]
    for name, needed, limit in zip(robot.joints, load, cell.bounds.torque, strict=True):
        if needed > limit:
            raise RobotError(
                f"robot.{key}: joint '{name}' carries {needed:.4g} N m there; its torque limit is"
                f" {limit:g}"
            )
    for pair in unintended_contacts(data, cell.touch):
        first, second = (lookup.geom_name(cell.model, geom) for geom in pair)
        raise RobotError(
            f"robot.{key}: '{first}' touches '{second}'; move {key} or the object, name a support,"
            " or exclude the pair"
        )
